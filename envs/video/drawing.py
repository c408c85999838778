"""Draws forecasts (dashed), true futures (thin), edges (as wide as they are likely) and plans of the ego.

Takes positions and returns RGB arrays. `envs.video.highway` and `envs.video.multiagent` play the episodes.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

Color = tuple[int, int, int]
Polyline = Float[np.ndarray, "_ 2"]

MIN_OPACITY = 0.12
"""Opacity of a forecast without any probability."""
SMOOTHING = 2
"""Factor by which pictures are drawn larger before they are scaled down."""
MARGIN_PX = 8.0
"""Distance between content and the border of the picture, or of a box [px]."""
_SAMPLE_PX = 34.0
_ARENA_MARGIN = 0.06  # of the longer side
_MIN_ASPECT = 0.4
_MIN_ARENA_M = 1e-3
_GRID_LINES = 6  # at least, along the longer side


@dataclass(frozen=True)
class OverlayStyle:
    """Colours [RGB] and widths [px of the picture] of an overlay."""

    forecast_color: Color = (255, 190, 40)
    """Colour of forecasts: a dashed line, a dot per step."""
    forecast_width_px: float = 2.0
    """Width of the dashes [px]."""
    dash_px: float = 7.0
    """Length of a dash and of a gap [px]."""
    truth_color: Color = (15, 15, 15)
    """Colour of the true future: a solid line."""
    truth_width_px: float = 1.5
    """Width of the line of the true future [px]."""
    edge_color: Color = (235, 90, 220)
    """Colour of edges from an agent to the ego, or to the agent in focus."""
    edge_width_px: float = 8.0
    """Width of an edge of probability 1 [px]."""
    edge_alpha: int = 150
    """Opacity of edges, 0–255."""
    safe_color: Color = (70, 220, 120)
    """Colour of a plan without any risk."""
    risky_color: Color = (240, 70, 60)
    """Colour of a plan that is sure to collide; risks between get colours between."""
    plan_width_px: float = 3.0
    """Width of the ego's path in a plan [px]."""
    min_edge_prob: float = 0.02
    """Smallest probability of an edge that is drawn."""
    text_px: int = 15
    """Height of text [px]."""
    text_color: Color = (240, 240, 240)
    """Colour of caption and legend."""

    def risk_color(self, risk: float) -> Color:
        """Returns the colour of a plan with this risk."""
        ends = zip(self.safe_color, self.risky_color, strict=True)
        red, green, blue = (round(safe + risk * (risky - safe)) for safe, risky in ends)
        return red, green, blue


@dataclass(frozen=True)
class AgentOverlay:
    """Lines and edge of one agent; world positions [m]."""

    now_m: tuple[float, float]
    """Position in this picture."""
    forecast_m: tuple[Polyline, ...]
    """One line per sample, from its position when the forecast was made."""
    truth_m: Polyline
    """True future positions."""
    edge_prob: float
    """Probability that it interacts with the ego."""
    shares: tuple[float, ...] = ()
    """Probability of each sample; empty draws all of them opaque."""


@dataclass(frozen=True)
class PlanOverlay:
    """Path of the ego in one of its plans, and what the others are forecast to do then; world positions [m]."""

    path_m: Polyline
    """Path of the ego, from its position when the plan was made."""
    others_m: tuple[Polyline, ...]
    """Single forecast of each other agent, from its position then."""
    risk: float
    """Probability of a collision within the horizon; sets the colour."""


@dataclass(frozen=True)
class View:
    """Maps world positions to pixels like highway-env's surface, without rounding."""

    origin_m: tuple[float, float]
    """World position of the upper left corner."""
    scaling: float
    """Pixels per metre."""
    y_up: bool = False
    """Whether the world's y axis points up in the picture."""

    def pixels(self, positions_m: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2"]:
        """Returns pixel positions (x to the right, y down)."""
        return (positions_m - np.array(self.origin_m)) * self.scaling * (1.0, -1.0 if self.y_up else 1.0)


@dataclass(frozen=True)
class Arena:
    """Part of the world that fills the picture, with a grid that shows the scale."""

    view: View
    """Map from world positions to pixels of the arena."""
    size_px: tuple[int, int]
    """Width and height [px], both even."""
    grid_m: float
    """Distance between two lines of the grid [m]: 1, 2 or 5 times a power of ten."""

    @classmethod
    def around(
        cls, places_m: Float[np.ndarray, "places 2"], radii_m: Float[np.ndarray, " places"], longest_px: int, y_up: bool
    ) -> "Arena":
        """Returns an arena that holds discs (at least one) with a margin; its longer side is `longest_px`."""
        low, high = (places_m - radii_m[:, None]).min(axis=0), (places_m + radii_m[:, None]).max(axis=0)
        longest_m = max(float((high - low).max()), _MIN_ARENA_M)
        spans_m = np.maximum(high - low, _MIN_ASPECT * longest_m) + 2 * _ARENA_MARGIN * longest_m
        corner_m = (low + high - spans_m) / 2
        if y_up:
            corner_m[1] += spans_m[1]
        scaling = longest_px / float(spans_m.max())
        width, height = (2 * round(span_m * scaling / 2) for span_m in spans_m.tolist())
        power = 10.0 ** math.floor(math.log10(longest_m / _GRID_LINES))
        grid_m = power * max((f for f in (1, 2, 5) if f * power <= longest_m / _GRID_LINES), default=1)
        return cls(View((float(corner_m[0]), float(corner_m[1])), scaling, y_up), (width, height), grid_m)

    def grid(self) -> list[Polyline]:
        """Returns lines at multiples of `grid_m` [px]."""
        width, height = self.size_px
        x_m, y_m = self.view.origin_m
        spans_m = np.array(self.size_px) / self.view.scaling
        xs_m = _multiples(self.grid_m, x_m, x_m + spans_m[0])
        low_m = y_m - spans_m[1] if self.view.y_up else y_m
        ys_m = _multiples(self.grid_m, low_m, low_m + spans_m[1])
        xs_px = self.view.pixels(np.stack([xs_m, np.zeros_like(xs_m)], axis=-1))[:, 0]
        ys_px = self.view.pixels(np.stack([np.zeros_like(ys_m), ys_m], axis=-1))[:, 1]
        upright = [np.array([[x, 0.0], [x, height]]) for x in xs_px]
        return upright + [np.array([[0.0, y], [width, y]]) for y in ys_px]


def _multiples(step: float, low: float, high: float) -> Float[np.ndarray, " multiples"]:
    """Returns the multiples of `step` between `low` and `high`."""
    return np.arange(math.ceil(low / step), math.floor(high / step) + 1) * step


def draw_overlay(
    picture: Image.Image,
    view: View,
    ego_m: tuple[float, float],
    agents: list[AgentOverlay],
    caption: str,
    style: OverlayStyle,
    plans: Sequence[PlanOverlay] = (),
    future_known: bool = True,
) -> UInt8[np.ndarray, "height width 3"]:
    """Draws edges, true futures, forecasts, caption and legend over a picture; returns the result.

    With plans of the ego, the forecasts are those for each plan, in the colour of its risk, the riskiest first. Where
    the future is not known, the legend does not name it.
    """
    size = (picture.width * SMOOTHING, picture.height * SMOOTHING)
    overlay = Image.new("RGBA", size, (0, 0, 0, 0))
    pen = Pen(ImageDraw.Draw(overlay), style)
    ego = view.pixels(np.array([ego_m]))[0]
    for agent in agents:
        if agent.edge_prob >= style.min_edge_prob:
            pen.edge(np.stack([ego, view.pixels(np.array([agent.now_m]))[0]]), agent.edge_prob)
    for agent in agents:
        pen.truth(view.pixels(agent.truth_m))
    for agent in agents:
        for line, share in () if plans else fan(agent.forecast_m, agent.shares):
            pen.forecast(view.pixels(line), opacity=share)
    for plan in sorted(plans, key=lambda plan: -plan.risk):
        color = style.risk_color(plan.risk)
        pen.line(view.pixels(plan.path_m), style.plan_width_px, (*color, 255))
        for line in plan.others_m:
            pen.forecast(view.pixels(line), color)
    legend = PLAN_LEGEND if plans else FORECAST_LEGEND
    shown = legend if future_known else [entry for entry in legend if entry[1] is not Pen.truth]
    _draw_captions(pen, picture.size, caption, shown)
    smooth = overlay.resize(picture.size, Image.Resampling.BOX)
    result = picture.convert("RGB")
    result.paste(smooth, mask=smooth)
    return np.asarray(result)


def fan(lines: Iterable[Polyline], shares: Iterable[float] = ()) -> list[tuple[Polyline, float]]:
    """Returns lines with opacities, the faintest first: the likeliest is opaque; without shares, all are."""
    drawn = list(lines)
    listed = [float(share) for share in shares] or [1.0] * len(drawn)
    opacities = [MIN_OPACITY + (1 - MIN_OPACITY) * share / max(listed) for share in listed]
    return sorted(zip(drawn, opacities, strict=True), key=lambda pair: pair[1])


def dashes(line: Polyline, dash: float, low: tuple[float, float], high: tuple[float, float]) -> list[Polyline]:
    """Cuts a polyline into dashes of length `dash` with gaps of equal length; corners are kept.

    Only dashes that reach into the box between two corners come back: a line may end a thousand kilometres away.
    """
    lengths = np.hypot(*np.diff(line, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    enter, leave = _inside(line, low, high)
    firsts = np.ceil((along[:-1] + enter * lengths - dash) / (2 * dash)).clip(0)
    lasts = np.floor((along[:-1] + leave * lengths) / (2 * dash))
    numbers = {n for first, last in zip(firsts, lasts, strict=True) for n in range(int(first), int(last) + 1)}
    pieces = []
    for start in (number * 2 * dash for number in sorted(numbers)):
        if start >= along[-1]:
            break
        end = min(start + dash, along[-1])
        inside = along[(along > start) & (along < end)]
        at = np.concatenate([[start], inside, [end]])
        pieces.append(np.stack([np.interp(at, along, line[:, 0]), np.interp(at, along, line[:, 1])], axis=-1))
    return pieces


def _inside(
    line: Polyline, low: tuple[float, float], high: tuple[float, float]
) -> tuple[Float[np.ndarray, " pieces"], Float[np.ndarray, " pieces"]]:
    """Returns at which share of each straight piece it enters a box and leaves it; enters at 1, leaves at 0 if never.

    Clips as Liang and Barsky do.
    """
    steps = np.diff(line, axis=0)
    steps[steps == 0] = 1e-12  # along an axis: inside or outside of the box as a whole
    to_low, to_high = (low - line[:-1]) / steps, (high - line[:-1]) / steps
    enter = np.minimum(to_low, to_high).max(axis=1).clip(0, 1)
    leave = np.maximum(to_low, to_high).min(axis=1).clip(0, 1)
    never = enter > leave
    return np.where(never, 1.0, enter), np.where(never, 0.0, leave)


@dataclass(frozen=True)
class Pen:
    """Draws in pixels of the picture on a canvas `SMOOTHING` times larger."""

    canvas: ImageDraw.ImageDraw
    """Canvas of an RGBA picture, or one that blends."""
    style: OverlayStyle
    """Colours and widths."""

    def edge(self, line: Polyline, prob: float) -> None:
        """Draws an edge whose width is proportional to its probability."""
        self.line(line, max(1.0, prob * self.style.edge_width_px), (*self.style.edge_color, self.style.edge_alpha))

    def truth(self, line: Polyline) -> None:
        """Draws a true future: thin and solid."""
        self.line(line, self.style.truth_width_px, (*self.style.truth_color, 255))

    def forecast(self, line: Polyline, color: Color | None = None, opacity: float = 1.0) -> None:
        """Draws a forecast: dashed, with a dot at each point but the first; None takes the style's colour."""
        paint = (*(color or self.style.forecast_color), round(255 * opacity))
        margin = self.style.forecast_width_px
        width, height = (side / SMOOTHING + margin for side in self.canvas.im.size)
        for piece in dashes(line, self.style.dash_px, (-margin, -margin), (width, height)):
            self.line(piece, self.style.forecast_width_px, paint)
        for point in line[1:]:
            self.disc(point, 1.2 * self.style.forecast_width_px, paint)

    def disc(self, center: Float[np.ndarray, "2"], radius: float, color: tuple[int, int, int, int]) -> None:
        """Draws a filled disc."""
        corners = np.concatenate([center - radius, center + radius]) * SMOOTHING
        self.canvas.ellipse(corners.tolist(), fill=color)

    def ring(
        self, center: Float[np.ndarray, "2"], radius: float, width: float, color: tuple[int, int, int, int]
    ) -> None:
        """Draws a circle whose width lies within the radius."""
        corners = np.concatenate([center - radius, center + radius]) * SMOOTHING
        self.canvas.ellipse(corners.tolist(), outline=color, width=round(width * SMOOTHING))

    def box(self, left: float, top: float, right: float, bottom: float) -> None:
        """Draws a dark background for text."""
        corners = [value * SMOOTHING for value in (left, top, right, bottom)]
        self.canvas.rounded_rectangle(corners, radius=4 * SMOOTHING, fill=(25, 25, 25, 190))

    def text(self, x: float, y: float, text: str) -> float:
        """Draws text with the vertical middle at y; returns the x of its end."""
        font, fill = _font(self.style.text_px * SMOOTHING), (*self.style.text_color, 255)
        self.canvas.text((x * SMOOTHING, y * SMOOTHING), text, fill=fill, font=font, anchor="lm")
        return x + self.text_width(text)

    def text_width(self, text: str) -> float:
        """Returns the width of a text [px]."""
        return self.canvas.textlength(text, font=_font(self.style.text_px * SMOOTHING)) / SMOOTHING

    def line(self, line: Polyline, width: float, color: tuple[int, int, int, int]) -> None:
        """Draws a solid line; nothing for a single point."""
        if len(line) < 2:
            return
        points = [(float(x), float(y)) for x, y in line * SMOOTHING]
        self.canvas.line(points, fill=color, width=max(1, round(width * SMOOTHING)), joint="curve")

    def legend(self, x: float, y: float, entries: "Legend") -> None:
        """Draws a sample of each entry and its name, side by side with the vertical middle at y."""
        for name, draw in entries:
            draw(self, np.array([[x, y], [x + _SAMPLE_PX, y]]))
            x = self.text(x + _SAMPLE_PX + MARGIN_PX, y, name) + 2 * MARGIN_PX

    def legend_width(self, entries: "Legend") -> float:
        """Returns the width of a legend [px]."""
        return sum(_SAMPLE_PX + 3 * MARGIN_PX + self.text_width(name) for name, _ in entries) - 2 * MARGIN_PX


Legend = Sequence[tuple[str, Callable[[Pen, Polyline], None]]]
"""Names, each with a function that draws a sample along a line [px]."""


def blank(size_px: tuple[int, int], color: Color, style: OverlayStyle) -> tuple[Image.Image, Pen]:
    """Returns an empty picture, `SMOOTHING` times larger than `size_px` (width, height), and its blending pen."""
    picture = Image.new("RGB", (size_px[0] * SMOOTHING, size_px[1] * SMOOTHING), color)
    return picture, Pen(ImageDraw.Draw(picture, "RGBA"), style)


def draw_page(
    body: Image.Image, caption: str, above: Legend, below: Legend, width_px: int, style: OverlayStyle
) -> UInt8[np.ndarray, "height width 3"]:
    """Draws a picture on white, with the caption and a legend above and another legend below; its size is even.

    Args:
        body: picture, `SMOOTHING` times larger than on the page.
        caption: text of the first line.
        above: legend of the second line.
        below: legend of the last line.
        width_px: width of the page, at least `page_width`.
        style: style of text and samples.
    """
    line_px = style.text_px + MARGIN_PX
    top = round(2 * line_px + MARGIN_PX)
    height_px = 2 * math.ceil((top + body.height / SMOOTHING + line_px + MARGIN_PX) / 2)
    page, pen = blank((width_px, height_px), (255, 255, 255), style)
    page.paste(body, ((page.width - body.width) // 2, top * SMOOTHING))
    pen.text(MARGIN_PX, (MARGIN_PX + line_px) / 2, caption)
    pen.legend(MARGIN_PX, (MARGIN_PX + 3 * line_px) / 2, above)
    pen.legend(MARGIN_PX, height_px - (MARGIN_PX + line_px) / 2, below)
    return np.asarray(page.resize((width_px, height_px), Image.Resampling.BOX))


def page_width(body_px: int, caption: str, legends: Iterable[Legend], style: OverlayStyle) -> int:
    """Returns the width of a page for a body of this width, the caption and the widest legend [px]; even."""
    _, pen = blank((1, 1), (255, 255, 255), style)
    inner = max(float(body_px), pen.text_width(caption), *(pen.legend_width(legend) for legend in legends))
    return 2 * math.ceil(inner / 2 + MARGIN_PX)


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


FORECAST_LEGEND: Legend = (
    ("forecast", Pen.forecast),
    ("what happened", Pen.truth),
    ("edge to the ego (probability)", lambda pen, line: pen.edge(line, 0.7)),
)
PLAN_LEGEND: Legend = (
    ("plan of the ego without risk, and the others then", lambda pen, line: _plan_sample(pen, line, 0.0)),
    ("with a sure collision", lambda pen, line: _plan_sample(pen, line, 1.0)),
    *FORECAST_LEGEND[1:],
)


def _plan_sample(pen: Pen, line: Polyline, risk: float) -> None:
    color = pen.style.risk_color(risk)
    pen.line(line - (0.0, 4.0), pen.style.plan_width_px, (*color, 255))
    pen.forecast(line + (0.0, 4.0), color)


def _draw_captions(pen: Pen, size: tuple[int, int], caption: str, entries: Legend) -> None:
    """Draws the caption in the upper left corner, the legend in the lower left one."""
    height = pen.style.text_px + 8.0
    pen.box(MARGIN_PX, MARGIN_PX, 3 * MARGIN_PX + pen.text_width(caption), MARGIN_PX + height)
    pen.text(2 * MARGIN_PX, MARGIN_PX + height / 2, caption)
    top = size[1] - MARGIN_PX - height
    pen.box(MARGIN_PX, top, 4 * MARGIN_PX + pen.legend_width(entries), top + height)
    pen.legend(2 * MARGIN_PX, top + height / 2, entries)
