"""Names that are like a given one."""

from darswin.utils.nearest import did_you_mean, nearest

NAMES = ["Mei", "Spherical", "darswin_a_small", "darswin_a_tiny"]


def test_similar_names_come_first():
    assert nearest("spherica", NAMES) == ["Spherical"] and nearest("x", NAMES) == []
    assert nearest("DARSWIN_A_SMAL", NAMES, 2, 0.7) == ["darswin_a_small", "darswin_a_tiny"]
    assert nearest("darswin_a_smal", NAMES) == ["darswin_a_small"]
    assert nearest("Kanala", ["KannalaBrandt", "Mei"]) == ["KannalaBrandt"]
    assert len(nearest("x", NAMES, 3, 0)) == 3
    assert nearest("Mei" + "x" * 10**6, NAMES) == []


def test_the_end_of_a_sentence():
    assert did_you_mean("Meii", NAMES) == "; did you mean Mei?" and did_you_mean("x", NAMES) == "."
    both = did_you_mean("darswin_a_smal", NAMES, 2, 0.7)
    assert both == "; did you mean darswin_a_small or darswin_a_tiny?"
