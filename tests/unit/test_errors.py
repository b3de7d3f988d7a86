"""How a setting is refused."""

import pytest

from memcomp_lightning.errors import SettingError, require, require_choice, require_count


def test_message_has_name_value_allowed_and_remedy():
    with pytest.raises(SettingError) as caught:
        require(False, "gamma", 0.7, "a number in (0, 1/2)", "Choose 0.25.")
    assert str(caught.value) == "gamma = 0.7 is not allowed: expected a number in (0, 1/2). Choose 0.25."


def test_message_without_remedy_ends_after_what_is_allowed():
    with pytest.raises(SettingError) as caught:
        require(False, "readout", "bst", "'best'")
    assert str(caught.value) == "readout = 'bst' is not allowed: expected 'best'."


def test_setting_error_is_a_value_error():
    assert issubclass(SettingError, ValueError)


@pytest.mark.parametrize("value", [0, -3, 1.0, 2.5, "3", None, True])
def test_count_is_refused(value):
    with pytest.raises(SettingError, match=r"^k = .* is not allowed: expected an integer >= 1"):
        require_count("k", value)


def test_count_from_the_minimum_on_is_accepted():
    require_count("k", 1)
    require_count("k", 2, minimum=2)
    with pytest.raises(SettingError, match="expected an integer >= 2"):
        require_count("k", 1, minimum=2)


def test_choice_lists_the_options():
    require_choice("reg", "l1", ["l1", "l2"])
    with pytest.raises(SettingError, match=r"^reg = 'l3' is not allowed: expected one of 'l1', 'l2'"):
        require_choice("reg", "l3", ["l1", "l2"])
