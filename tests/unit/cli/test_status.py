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


def test_other_errors_are_not_hidden():
    with pytest.raises(ZeroDivisionError):
        run_command("sim.fly", lambda: 1 // 0)
