"""Exit statuses of command lines, and the line that says why."""

from __future__ import annotations

import pytest

from flockopt.cli.status import run_command
from flockopt.errors import SettingsError, SolverFailed


@pytest.mark.parametrize(("given", "status"), [(None, 0), (0, 0), (1, 1)])
def test_a_command_ends_with_its_own_status(given, status, capsys):
    assert run_command("sim.fly", lambda: given) == status
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("fault", [SettingsError("jobs", "is 0", "must be an integer >= 1"), SolverFailed("casadi", "a\nb")])
def test_bad_input_is_2_and_one_line(fault, capsys):
    def refuse():
        raise fault

    assert run_command("sim.fly", refuse) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("sim.fly: ") and err.count("\n") == 1
    assert fault.args[0].partition("\n")[0] in err


def test_a_fault_of_the_program_has_its_own_status_and_tells_where_it_is_if_asked(capsys, monkeypatch):
    assert run_command("sim.fly", lambda: 1 // 0) == 3
    err = capsys.readouterr().err
    assert err.startswith("sim.fly: a fault of the program, not of its input: ZeroDivisionError: ")
    assert "Traceback" not in err and "FLOCKOPT_TRACEBACK=1" in err
    monkeypatch.setenv("FLOCKOPT_TRACEBACK", "1")
    assert run_command("sim.fly", lambda: 1 // 0) == 3
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (MemoryError(), "out of memory"),
        (OSError(28, "No space left on device"), "the machine refuses: No space left on device"),
    ],
)
def test_a_machine_that_fails_has_a_status_of_its_own(fault, words, capsys):
    def work():
        raise fault

    assert run_command("sim.fly", work) == 3
    assert words in capsys.readouterr().err


def test_an_interrupt_is_one_even_where_compiled_code_hides_it(capsys):
    def work():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as fault:
            raise SystemError("returned a result with an exception set") from fault

    assert run_command("sim.fly", work) == 130
    assert capsys.readouterr().err.startswith("sim.fly: interrupted")
