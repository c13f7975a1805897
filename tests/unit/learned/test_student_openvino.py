"""The backends compute what the modules do, for scenes of any size; which is taken, and what OpenVINO keeps on disk."""

from __future__ import annotations

import hashlib
import sys

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch comes with the extra 'learned'")


from flockopt import MissingExtra, SettingsError  # noqa: E402 - torch may be missing
from learned.student.backends.choice import BACKENDS, loaded, network  # noqa: E402
from learned.student.backends.compiled_files import CompiledFiles, digest_of  # noqa: E402
from learned.student.backends.graphs import TracedStudent  # noqa: E402
from learned.student.backends.openvino import OpenVinoStudent  # noqa: E402
from learned.student.inference import decide, draw  # noqa: E402
from learned.student.scenes.batch import collate  # noqa: E402
from tests.student_scenes import taught_example, tiny_student  # noqa: E402

#: Probability and metres by which OpenVINO may differ from torch.
TOLERANCES = {"f32": (1e-5, 1e-4), "bf16": (5e-2, 5e-2)}

SIZES = (("forest", 6, 12), ("rooms", 3, 7), ("city", 9, 20))


def answers(student, examples):
    """Probabilities of all scenes, and samples with three tries."""
    probabilities, tokens = decide(student, collate(examples))
    drawings = draw(student, examples, tries=1, seed=2, tokens=tokens)
    return probabilities, [drawing.samples for drawing in drawings]


def test_traced_once_for_all_sizes():
    student = tiny_student("small")
    traced = TracedStudent(student)
    for family, drones, tasks in SIZES:
        examples = [taught_example(family, drones=drones, tasks=tasks, seed=seed) for seed in (1, 2)]
        for part in (examples[:1], examples):
            for expected, found in zip(answers(student, part), answers(traced, part), strict=True):
                assert all(np.allclose(*pair, atol=1e-5) for pair in zip(expected, found, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("precision", TOLERANCES)
def test_outputs_are_those_of_torch(precision, tmp_path):
    pytest.importorskip("openvino", reason="OpenVINO comes with the extra 'openvino'")
    student = tiny_student("small")
    for compiled in (OpenVinoStudent(student, precision, tmp_path), OpenVinoStudent(student, precision, tmp_path)):
        for family, drones, tasks in SIZES:
            examples = [taught_example(family, drones=drones, tasks=tasks, seed=seed) for seed in (1, 2)]
            expected, found = answers(student, examples), answers(compiled, examples)
            for tolerance, ours, theirs in zip(TOLERANCES[precision], expected, found, strict=True):
                assert all(np.allclose(*pair, atol=tolerance) for pair in zip(ours, theirs, strict=True))
    assert list(tmp_path.glob("*.graph"))  # the second one found them


def test_files_are_whole_of_this_student_or_not_there(tmp_path):
    student = tiny_student("small")
    files = CompiledFiles(tmp_path / "new", digest_of(student, "1"))
    assert files.read("head") is None
    files.write("head", b"a graph")
    assert files.read("head") == b"a graph" and files.read("tail") is None
    assert CompiledFiles(tmp_path / "new", digest_of(student, "2")).read("head") is None
    assert CompiledFiles(tmp_path / "new", digest_of(tiny_student("small", seed=1), "1")).read("head") is None
    (path,) = (tmp_path / "new").iterdir()
    path.write_bytes(path.read_bytes()[:-1] + b"!")
    assert files.read("head") is None
    (tmp_path / "file").write_bytes(b"")
    CompiledFiles(tmp_path / "file" / "folder", "digest").write("head", b"a graph")  # nowhere to keep it: no error


def test_what_computes_and_which_weights_can_be_read_off(tmp_path):
    path = tmp_path / "weights.safetensors"
    path.write_bytes(b"weights")
    small, paper, digest = tiny_student("small"), tiny_student("paper"), hashlib.sha256(b"weights").hexdigest()
    for student, backend, used in ((small, None, "torch"), (paper, None, "torch-eager"), (small, "torch-eager", "torch-eager")):
        found = loaded(student, path, backend)
        assert (found.backend, found.digest) == (used, digest)
        assert found.network is network(student, used)
    with pytest.raises(SettingsError, match=rf"backend is 'cuda'; must be one of torch, .*{BACKENDS[-1]}"):
        loaded(small, path, "cuda")
    with pytest.raises(SettingsError, match=r"gone\.safetensors cannot be read"):
        loaded(small, tmp_path / "gone.safetensors")


def test_each_backend_takes_what_it_can():
    small, paper = tiny_student("small"), tiny_student("paper")
    assert isinstance(network(small, "torch"), TracedStudent)
    assert network(small, "torch-eager") is small
    for backend in ("torch", "openvino-f32"):
        with pytest.raises(SettingsError, match="fleet attention"):
            network(paper, backend)
    with pytest.raises(SettingsError, match="precision is 'f16'"):
        OpenVinoStudent(small, "f16")


def test_missing_openvino_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "openvino", None)
    with pytest.raises(MissingExtra, match="openvino is not installed"):
        OpenVinoStudent(tiny_student("small"))
