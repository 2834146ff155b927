from itertools import product
from pathlib import Path

import pytest
from scipy.stats import norm

from identification.signals.contact_rule import CONTACT


@pytest.mark.parametrize("residual", [0.0, 0.3, 1.0, 5.0])
def test_a_hold_is_a_touch_too(residual: float) -> None:
    held = CONTACT.hold_threshold_n(residual)
    assert held >= CONTACT.touch_threshold_n(held)
    assert CONTACT.restless_factor * CONTACT.smallest_n == CONTACT.smallest_hold_n


def test_noise_is_no_contact() -> None:
    """An hour at 10 kHz has 3.6e7 samples."""
    for deviations in (CONTACT.hold_residuals, CONTACT.touched_noises):
        assert 2.0 * norm.sf(deviations) * 3.6e7 < 0.1


def test_the_thresholds_are_written_in_one_place(repository: Path) -> None:
    users = ("joint_fit/segments.py", "timeline/contacts.py", "timeline/payload.py", "timeline/left_contacts.py")
    texts = [(repository / "identification" / each).read_text(encoding="utf-8") for each in users]
    texts.append((repository / "autotune/validation/log_contacts.py").read_text(encoding="utf-8"))
    names = ("_TOUCHED_SHARE =", "_LONGEST_BOUNCE_S =", "_SMALLEST_LEAD_S =", "_RESIDUAL_N =")
    assert all("import CONTACT" in text for text in texts)
    assert [name for name, text in product(names, texts) if name in text] == []
