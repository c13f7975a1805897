"""OpenVINO computes what torch does, for scenes of any size, from one compilation."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("openvino")

from flockopt import SettingsError  # noqa: E402 - torch may be missing
from learned.student.batch import collate  # noqa: E402
from learned.student.inference import draw, task_probabilities  # noqa: E402
from learned.student.openvino_backend import OpenVinoStudent  # noqa: E402
from tests.student_scenes import taught_example, tiny_student  # noqa: E402

#: Metres and probability by which the two may differ, in float32.
TOLERANCE = 1e-4


@pytest.mark.slow
def test_outputs_are_those_of_torch():
    student = tiny_student("small")
    compiled = OpenVinoStudent(student)
    for family, drones, tasks in (("forest", 6, 12), ("rooms", 3, 7), ("city", 9, 20)):
        one = taught_example(family, drones=drones, tasks=tasks, seed=1)
        probabilities = [task_probabilities(each, collate([one]))[0] for each in (student, compiled)]
        assert np.allclose(*probabilities, atol=TOLERANCE)
        samples = [draw(each, [one], tries=1, seed=2)[0].samples for each in (student, compiled)]
        assert np.allclose(*samples, atol=TOLERANCE)


def test_what_cannot_be_compiled_is_named():
    with pytest.raises(SettingsError, match="fleet attention"):
        OpenVinoStudent(tiny_student("paper"))
    with pytest.raises(SettingsError, match="precision is 'f16'"):
        OpenVinoStudent(tiny_student("small"), "f16")
