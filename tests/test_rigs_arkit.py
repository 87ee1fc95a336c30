import pytest

from reenact.rigs import arkit


def test_there_are_52_different_names_of_which_18_pairs():
    assert len(set(arkit.NAMES)) == 52
    assert len(arkit.PAIRS) == 18
    assert all(left in arkit.NAMES and right in arkit.NAMES for left, right in (*arkit.PAIRS, *arkit.DIRECTIONS))


def test_every_shape_is_in_one_region():
    assert sorted(name for names in arkit.REGIONS.values() for name in names) == sorted(arkit.NAMES)


@pytest.mark.parametrize("name", arkit.NAMES)
def test_every_usual_spelling_is_understood(name):
    short = name.replace("Left", "_L").replace("Right", "_R")
    snake = "".join("_" + letter.lower() if letter.isupper() else letter for letter in name)
    for spelling in (name, name[0].upper() + name[1:], short, snake, snake.upper(), snake.replace("_", "-")):
        assert arkit.canonical(spelling) == name
        assert arkit.canonical(f"head:{spelling}") == name
    assert arkit.canonical(f"blendShape1.{short}") == name


def test_halves_of_a_split_shape_are_the_shape():
    assert arkit.canonical("browInnerUp_L") == arkit.canonical("browInnerUpRight") == "browInnerUp"
    assert arkit.canonical("cheekPuff_R") == "cheekPuff"


def test_a_merged_pair_stands_for_both_sides_and_spells_neither():
    assert arkit.meaning("eyeBlink") == ("eyeBlinkLeft", "eyeBlinkRight")
    assert arkit.canonical("eyeBlink") is None
    assert arkit.meaning("eyeLookLeft") == ("eyeLookOutLeft", "eyeLookInRight")
    assert arkit.meaning("jaw") == ()  # jawLeft and jawRight are opposites, not a pair


@pytest.mark.parametrize("name", ["", "smile", "mouth-open", "eye-left-closure", "jawOpened", "A", "eyeBlink_M", "::"])
def test_other_names_are_not_arkit(name):
    assert arkit.canonical(name) is None


def test_a_side_is_a_word_of_its_own():
    assert arkit.sides("eye-left-closure") == ("eye * closure", "left")
    assert arkit.sides("Eye_Blink.R") == ("eye blink *", "right")
    assert arkit.sides("eyeBlinkL") == ("eye blink *", "left")
    assert arkit.sides("mouthRollLower") == ("mouth roll lower", None)
    assert arkit.sides("upright") == ("upright", None)
    assert arkit.sides("left to right") == ("left to right", None)
