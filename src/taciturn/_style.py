"""Style of all figures: a colour and a marker for each kind of curve, the fonts, and the class of the figures.

A *thing* has one colour and one mark in every figure (``THINGS``): the policy, a policy whose actuator holds its input
(next to one that predicts), sending every sample, periodic control, the guarantee, a certificate, packets that are
delivered, dropped or late, triggers and their thresholds, set-points, limits, disturbances, the lower bound of all
schedules, and the region that no schedule reaches. Signals without a
meaning of their own, such as the entries of a state, are those of ``SIGNALS`` in turn. Several signals of one thing,
such as the outputs under periodic control, have its colour in a tone and a dash of their own. A ``Look`` is a colour, a
dash and a marker, so that a figure can be read in grey print and by colour-blind readers; the hues are those of Okabe
and Ito, with a lightness that contrasts with the background by at least 3 : 1.

A ``Style`` gives the hues for a background, and the fonts:

* ``light`` and ``dark``, 7 inches wide (9 with two sides), for screens,
* ``paper`` and ``paper-wide``, 3.5 and 7.16 inches wide, one and two columns of a journal: 8 points, a serif font
  (STIX, which matplotlib contains, also for formulas), and thin lines. A figure with two sides has two columns.

Files embed their fonts. A notebook shows a light figure as an SVG that adapts to the reader's colour scheme: its hues
are variables, which have other values where dark colours are preferred, by the reader or by the page (its CSS property
``color-scheme``). It has a background of its own, so that it is legible on any page. Nothing here changes matplotlib's
settings outside of these figures.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from typing import Any, Literal, TypeAlias, cast

from taciturn.errors import ProblemError

Hue = Literal[
    "blue",
    "amber",
    "green",
    "purple",
    "sky",
    "olive",
    "red",
    "ink",
    "muted",
    "shade",
    "forbidden",
    "grid",
    "box",
    "hub",
]
Marker = Literal["o", "s", "^", "D", "v", "P", "X", "*", "|", "x", ">", ""]
Dash: TypeAlias = tuple[float, ...]
Thing = Literal[
    "policy", "held", "every sample", "periodic control", "guarantee", "certificate", "lower bound", "unreachable",
    "delivered", "dropped", "late", "trigger", "threshold", "set-point", "limits", "disturbance",
]  # fmt: skip
StyleName = Literal["light", "dark", "paper", "paper-wide"]
_EMBEDDED: Mapping[str, Any] = {
    "svg.hashsalt": "taciturn", "svg.fonttype": "path", "pdf.fonttype": 42, "ps.fonttype": 42,
}  # fmt: skip
"""Settings for reproducible files with embedded fonts, of the kind that publishers require (TrueType)."""
SOLID: Dash = ()
DASHED, DOTTED = (4.5, 1.8), (1.0, 1.4)


@dataclass(frozen=True)
class Look:
    """Appearance of a curve: colour, marker, and dash pattern in multiples of the line width."""

    hue: Hue
    dash: Dash = SOLID
    marker: Marker = "o"
    width: float = 1.0  # of lines, relative to that of the style


THINGS: Mapping[Thing, Look] = {
    "policy": Look("blue", SOLID, "o", 1.15),
    "held": Look("olive", (6.0, 1.4, 1.2, 1.4), "P"),
    "every sample": Look("muted", (7.0, 2.0), "D"),
    "periodic control": Look("amber", DASHED, "s"),
    "guarantee": Look("green", DOTTED, "^", 1.3),
    "certificate": Look("purple", (6.0, 1.5, 1.2, 1.5), "v"),
    "lower bound": Look("muted", SOLID, ">"),
    "unreachable": Look("shade"),
    "delivered": Look("ink", SOLID, "|"),
    "dropped": Look("red", SOLID, "x"),
    "late": Look("purple", SOLID, "o"),
    "set-point": Look("ink", (3.0, 2.0), "", 0.9),
    "trigger": Look("muted", SOLID, "", 0.7),
    "threshold": Look("red", (4.0, 1.2, 1.0, 1.2), "", 0.8),
    "limits": Look("red", (1.5, 2.0), "", 0.8),
    "disturbance": Look("olive", SOLID, "", 0.9),
}
SIGNALS = (
    Look("blue"),
    Look("purple", (6.0, 1.4), "D"),
    Look("olive", (1.2, 1.0), "P"),
    Look("sky", (9.0, 1.4), "v"),
    Look("red", (6.0, 1.4, 1.2, 1.4, 1.2, 1.4), "X"),
    Look("green", (6.0, 1.4, 1.2, 1.4), "^"),
    Look("ink", (2.2, 1.2), "*"),
    Look("muted", SOLID, ">"),
)
"""Signals in turn. None has the colour of periodic control."""

TONES = (0.0, 0.5, 0.25, 0.75)
"""How much ink is in the colour of each of several signals of one thing."""

POLICIES: tuple[Thing | int, ...] = ("policy", "held", 4, 3, 1)
"""Looks of several policies in turn; none is that of guarantees, certificates and periodic control."""
KNOWN: Mapping[str, Thing] = {"periodic control": "periodic control", "hold": "held", "model": "policy"}
"""Looks of policies of a kind, or with an actuation, that figures know."""


def policy_looks(described: Sequence[Sequence[object]]) -> list[Thing | int]:
    """Return the looks of several policies, which are described by words such as their kind and actuation.

    Periodic control, a held input and an input from a model have the same look in all figures, whatever their order.
    The first policy with such a word has its look; the other policies have the looks that are left, in turn.
    """
    found: dict[int, Thing | int] = {}
    for word, thing in KNOWN.items():  # periodic control comes before its actuation
        here = (index for index, words in enumerate(described) if word in words and index not in found)
        first = next(here, None)
        if first is not None:
            found[first] = thing
    left: list[Thing | int] = [one for one in POLICIES if one not in found.values()]
    others = [index for index in range(len(described)) if index not in found]
    for turn, index in enumerate(others):
        found[index] = left[turn % len(left)]
    return [found[index] for index in range(len(described))]


@dataclass(frozen=True, eq=False)
class Style:
    """Colours for a light or dark background, and sizes of the letters (points), of lines (points) and of figures
    (inches).
    """

    name: StyleName
    background: str
    hues: Mapping[Hue, str]
    width: float = 7.0
    wide: float = 9.0  # width of a figure with two sides
    letters: float = 9.0
    line: float = 1.5
    tall: float = 1.0  # height of panels, relative to that of a figure for a screen
    serif: bool = False

    @property
    def spacing(self) -> float:
        """Distance of lines of text, relative to the height of the font, which is larger for a serif font."""
        return 0.95 if self.serif else 1.2

    def look(self, thing: Thing | int) -> Look:
        """Return colour, dash pattern and marker of a thing such as "input", or of the signal with a given number."""
        return THINGS[thing] if isinstance(thing, str) else SIGNALS[thing % len(SIGNALS)]

    def color(self, thing: Thing | int, tone: int = 0) -> str:
        """Return the colour of a thing such as "input", or of the signal with a given number, in one of its tones."""
        return self.toned(self.look(thing).hue, TONES[tone % len(TONES)])

    def toned(self, hue: Hue, ink: float) -> str:
        """Return a hue that is mixed with a share of ink."""
        pairs = [[int(color[k : k + 2], 16) for k in (1, 3, 5)] for color in (self.hues[hue], self.hues["ink"])]
        mixed = (round((1 - ink) * own + ink * other) for own, other in zip(*pairs, strict=True))
        return "#" + "".join(f"{one:02x}" for one in mixed) if ink else self.hues[hue]

    @property
    def settings(self) -> dict[str, Any]:
        """The settings of matplotlib with which figures in this style are drawn and saved."""
        small, thin = 0.9 * self.letters, 0.5 * self.line
        ink, muted, grid = self.hues["ink"], self.hues["muted"], self.hues["grid"]
        return {
            **_EMBEDDED,
            "font.family": ["STIXGeneral" if self.serif else "DejaVu Sans"],
            "mathtext.fontset": "stix" if self.serif else "dejavusans",
            "font.size": self.letters, "axes.titlesize": 1.05 * self.letters, "axes.labelsize": small,
            "xtick.labelsize": small, "ytick.labelsize": small, "legend.fontsize": small,
            "figure.facecolor": self.background, "savefig.facecolor": self.background,
            "axes.facecolor": self.background, "axes.edgecolor": muted, "axes.linewidth": thin,
            "axes.spines.top": False, "axes.spines.right": False,
            "axes.grid": True, "grid.color": grid, "grid.linewidth": 0.8 * thin, "axes.axisbelow": True,
            "text.color": ink, "axes.labelcolor": muted, "axes.titlecolor": ink,
            "xtick.color": muted, "ytick.color": muted, "xtick.labelcolor": muted, "ytick.labelcolor": muted,
            "xtick.major.size": 0.0, "ytick.major.size": 0.0, "xtick.minor.size": 0.0, "ytick.minor.size": 0.0,
            "lines.linewidth": self.line, "lines.markersize": 3.2 * self.line,
            "lines.solid_capstyle": "butt", "lines.dash_capstyle": "butt",
            "axes.xmargin": 0.015, "axes.ymargin": 0.06, "axes.formatter.useoffset": False,
            "hatch.linewidth": 0.6 * thin, "axes.formatter.limits": (-4, 5), "axes.formatter.use_mathtext": True,
            "figure.constrained_layout.h_pad": 0.06, "figure.constrained_layout.w_pad": 0.06,
        }  # fmt: skip


_LIGHT: Mapping[Hue, str] = {
    "blue": "#0072b2", "amber": "#c27500", "green": "#008a63", "purple": "#a3478f", "sky": "#3d97d3",
    "olive": "#7a6c00", "red": "#c9340c", "ink": "#1f2328", "muted": "#5b6570", "shade": "#e9ebee",
    "forbidden": "#fbeae5", "grid": "#e6e9ec", "box": "#f5f7f9", "hub": "#e7f1f8",
}  # fmt: skip
_DARK: Mapping[Hue, str] = {
    "blue": "#56b4e9", "amber": "#f0b441", "green": "#35c797", "purple": "#df93c9", "sky": "#a9b8ff",
    "olive": "#d3c75a", "red": "#ff7d57", "ink": "#e6edf3", "muted": "#9aa5b1", "shade": "#22282f",
    "forbidden": "#3b211b", "grid": "#2a3037", "box": "#20262d", "hub": "#17303f",
}  # fmt: skip
_PRINT: Mapping[Hue, str] = {
    **_LIGHT,
    "ink": "#000000",
    "muted": "#3a3f45",
    "grid": "#e2e2e2",
    "box": "#fdfdfd",
    "hub": "#eeeeee",
}
_PAPER = Style("paper", "#ffffff", _PRINT, 3.5, 7.16, 8.0, 1.0, 0.62, serif=True)
STYLES: Mapping[StyleName, Style] = {
    "light": Style("light", "#ffffff", _LIGHT),
    "dark": Style("dark", "#131416", _DARK),
    "paper": _PAPER,
    "paper-wide": Style("paper-wide", "#ffffff", _PRINT, 7.16, 7.16, 8.0, 1.0, 0.75, serif=True),
}


def style(name: StyleName = "light") -> dict[Any, Any]:
    """Return settings of matplotlib with which your own figures look like those of Taciturn.

    The settings contain the fonts, the colours of lines in turn, the axes and the grid. ``matplotlib.rcParams.update``
    takes them for a whole program, and ``matplotlib.rc_context`` for a block.

    Args:
        name: ``"light"`` or ``"dark"`` for a screen; ``"paper"`` or ``"paper-wide"`` for one or two columns of a
            journal.

    Returns:
        The settings by their names in ``matplotlib.rcParams``.

    Raises:
        ProblemError: there is no such style.

    Example:
        >>> import matplotlib
        >>> from taciturn import style
        >>> with matplotlib.rc_context(style("paper")):
        ...     matplotlib.rcParams["font.size"]
        8.0
    """
    from cycler import cycler

    chosen = find_style(name)
    colors = [chosen.color(number) for number in range(len(SIGNALS))]
    return {
        **chosen.settings,
        "figure.figsize": (chosen.width, 0.6 * chosen.width),
        "figure.constrained_layout.use": True,
        "axes.prop_cycle": cycler(color=colors),
        "legend.frameon": False,
        "image.cmap": "cividis",
    }


def find_style(name: Any) -> Style:
    """Return the style with the given name.

    Raises:
        ProblemError: there is no such style.
    """
    if not isinstance(name, str) or name not in STYLES:
        raise ProblemError(
            f"style is {name!r}; expected 'light' or 'dark' for a screen, or 'paper' or 'paper-wide' for one or two "
            "columns of a journal"
        )
    return STYLES[cast("StyleName", name)]


_PAINTED = re.compile(r"(fill|stroke): (#[0-9a-f]{6})")
_FILLED = re.compile(r'fill="(#[0-9a-f]{6})"')  # what is below a hatch


def adaptive(svg: str) -> str:
    """Change an SVG picture in the style ``light``, so that its colours follow the reader's light or dark colour
    scheme.
    """
    svg = _FILLED.sub(r'style="fill: \1"', svg)
    light, dark = STYLES["light"], STYLES["dark"]
    known = {light.toned(hue, ink): dark.toned(hue, ink) for ink in TONES[::-1] for hue in light.hues}
    known[light.background] = dark.background
    changed = {
        color: known[color] for color in dict.fromkeys(one for _, one in _PAINTED.findall(svg)) if color in known
    }

    def painted(found: re.Match[str]) -> str:
        return f"{found[1]}: var(--c{found[2][1:]})" if found[2] in changed else found[0]

    head, tag, body = svg.partition("<defs>")
    usual = "".join(f"--c{color[1:]}:{color};" for color in changed)
    others = "".join(f"--c{color[1:]}:{other};" for color, other in changed.items())
    rules = f"<style>svg{{{usual}}}@media (prefers-color-scheme: dark){{svg{{{others}}}}}</style>"
    return f"{head}{rules}{tag}{_PAINTED.sub(painted, body)}"


def __getattr__(name: str) -> Any:
    """Return the class of the figures by its name, so that figures can be pickled."""
    if name == "Drawn":
        return figure_class()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@cache
def figure_class() -> Any:
    """Define the class of all figures. The definition is inside a function because importing matplotlib is slow."""
    from matplotlib import rc_context  # pyright: ignore[reportUnknownVariableType]  # its stubs are partial
    from matplotlib.figure import Figure

    context = cast("Any", rc_context)

    plain: Any = Figure

    class Drawn(Figure):
        """A matplotlib figure in one of the styles. Notebooks show it without pyplot. Saved files embed the fonts."""

        style: Style = STYLES["light"]
        savefig: Any = context(_EMBEDDED)(plain.savefig)

        def draw(self, renderer: Any) -> None:
            """Draw the figure with the fonts of its style, including labels that matplotlib creates while drawing."""
            with context(self.style.settings):
                super().draw(renderer)

        def svg(self) -> str:
            """Write the figure as SVG for a web page. In the style ``light``, the colours adapt to dark pages."""
            written = BytesIO()
            self.savefig(written, format="svg", metadata={"Date": None, "Creator": None})
            text = written.getvalue().decode()
            return adaptive(text) if self.style.name == "light" else text

        def _repr_svg_(self) -> str:
            return self.svg()

        def _repr_png_(self) -> bytes:
            written = BytesIO()
            self.savefig(written, format="png", dpi=110)
            return written.getvalue()

    Drawn.__qualname__ = "Drawn"
    return Drawn
