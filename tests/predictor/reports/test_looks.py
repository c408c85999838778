from predictor.evaluation.paper_tables import SPRINGS
from predictor.reports.looks import BLUE, GREY, looks_of


def test_a_family_has_one_colour_in_every_plot_and_its_members_differ():
    names = ["constant velocity", "dG-VAE, K = 1", "dG-VAE, K = 20", "nearest neighbours", "constant velocity + noise"]
    looks = looks_of(names)
    assert [look["color"] for look in looks[:3]] == [GREY, BLUE, BLUE] and looks[4]["color"] == GREY
    assert len({tuple(look.values()) for look in looks}) == len(names)
    assert looks_of(names[::-1])[1]["color"] == looks[3]["color"], "in any order, in any plot"


def test_the_paper_s_model_is_not_drawn_as_the_enhanced_one():
    paper, enhanced = looks_of(["dG-VAE (paper)", "dG-VAE+"])
    assert paper["color"] != enhanced["color"] == BLUE


def test_checkpoints_differ_from_each_other_and_from_the_controls():
    names = ["highway", "merge", "generic", "constant velocity", "nearest neighbours"]
    assert len({look["color"] for look in looks_of(names)}) == len(names)
    assert looks_of(names)[0]["color"] == BLUE, "what the plot is about"


def test_all_lines_of_the_longest_table_differ():
    looks = looks_of(line.name for line in SPRINGS.lines)
    assert len({tuple(look.values()) for look in looks}) == len(looks)
