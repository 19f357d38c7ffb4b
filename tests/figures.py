"""How large the text of a figure is where it is shown small."""

from matplotlib.figure import Figure
from matplotlib.text import Text

PHONE = 390  # px, the width of a phone's screen


def texts_of(figure: Figure) -> list[Text]:
    """The texts that a figure shows."""
    figure.draw_without_rendering()  # makes the labels of ticks
    return [text for text in figure.findobj(Text) if text.get_text() and text.get_visible()]


def on_a_phone(figure: Figure) -> float:
    """The height of the smallest text in px, in a figure that is as wide as a phone's screen."""
    texts = texts_of(figure)
    assert texts and not any("$" in text.get_text() for text in texts)  # exponents are smaller
    return min(text.get_fontsize() for text in texts) / 72 / figure.get_figwidth() * PHONE
