"""Names of the 12 texture settings, and what is refused."""

import pytest

from skyproof.camouflage.name import TextureConstraints
from skyproof.errors import ConfigurationError

NAMES = {
    "U": (False, "free", False),
    "Ma": (False, "free", True),
    "Lc": (False, "learnt", False),
    "LcMa": (False, "learnt", True),
    "Fc": (False, "fixed", False),
    "FcMa": (False, "fixed", True),
    "Pix": (True, "free", False),
    "PixMa": (True, "free", True),
    "PixLc": (True, "learnt", False),
    "PixLcMa": (True, "learnt", True),
    "PixFc": (True, "fixed", False),
    "PixFcMa": (True, "fixed", True),
}


@pytest.mark.parametrize(("name", "settings"), NAMES.items())
def test_name_and_settings_belong_together(name, settings):
    constraints = TextureConstraints(*settings)
    assert constraints.name == name
    assert TextureConstraints.parse(name) == constraints


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("LcFc", "Lc and Fc exclude each other"),
        ("FcLc", "Lc and Fc exclude each other"),
        ("PixFcLcMa", "Lc and Fc exclude each other"),
        ("", "U for none"),
        ("Mask", "Unknown texture constraints 'Mask'"),
        ("pix", "Unknown texture constraints 'pix'"),
        ("UPix", "Unknown texture constraints"),
        ("MaPix", "must be written 'PixMa'"),
        ("PixPix", "must be written 'Pix'"),
    ],
)
def test_what_is_refused_says_why_in_one_sentence(text, complaint):
    with pytest.raises(ConfigurationError, match=complaint) as caught:
        TextureConstraints.parse(text)
    assert "\n" not in str(caught.value)
