"""Figure set-up."""

from matplotlib import rc_context

from hsi_sc_nerf.plotting import STYLE, logarithmic_axis, new_figure


def test_ticks_of_a_logarithmic_axis_are_numbers():
    with rc_context(STYLE):
        axes = new_figure(4.0, 3.0).subplots()
        logarithmic_axis(axes, "y")
        axes.set_ylim(0.001, 100.0)
        shown = [label.get_text() for label in axes.get_yticklabels() if label.get_text()]
    assert {"0.001", "0.1", "10"} <= set(shown)
    assert not any("$" in text for text in shown)
