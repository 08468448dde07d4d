"""What the generators of scenes drop is counted."""

from drake_oa.studies.results import Tally, drawn_figures, drawn_lines


def test_shares_are_of_all_scenes_the_greatest_first():
    one, other = Tally(), Tally()
    assert one.takes("courses", "")
    assert not one.takes("courses", "too high")
    for reason in ("", "too low", "too low"):
        other.takes("courses", reason)
    other.takes("scenes", "")
    drawn = drawn_figures([one.counts, other.counts])
    assert drawn == {
        "courses": {"looked_at": 5, "dropped": {"too low": 0.4, "too high": 0.2}},
        "scenes": {"looked_at": 1, "dropped": {}},
    }
    assert list(drawn["courses"]["dropped"]) == ["too low", "too high"]
    assert drawn_lines(drawn) == [
        "courses looked at: 5; dropped: 40.0% (too low), 20.0% (too high)",
        "scenes looked at: 1; dropped: none",
    ]
