"""Write tests/golden/student.json anew, after a change that is meant to change what the student computes.

python -m tests.golden.write_student
"""

from __future__ import annotations

import json
from pathlib import Path

from tests.unit.learned.test_student_network import golden_record

if __name__ == "__main__":
    target = Path(__file__).with_name("student.json")
    target.write_text(json.dumps(golden_record(), indent=1) + "\n", encoding="utf-8")
