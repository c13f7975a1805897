"""Optional dependencies: imported when they are asked for, and named with their extra where they are missing."""

from __future__ import annotations

import sys

import pytest

from flockopt.errors import MissingExtra, require


def test_what_is_installed_is_given():
    assert require("json.decoder", extra="show") is sys.modules["json.decoder"]


@pytest.mark.parametrize(
    ("module", "package", "named"), [("nowhere", "", "nowhere"), ("nowhere.figure", "", "nowhere"), ("nowhere", "Now", "Now")]
)
def test_what_is_missing_is_named_with_its_extra(module, package, named):
    with pytest.raises(MissingExtra) as caught:
        require(module, extra="show", package=package)
    told = f"{named} is not installed; it comes with the extra 'show'; pip install 'flockopt[show]', where it has a wheel"
    assert str(caught.value).startswith(told)
