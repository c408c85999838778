"""What is drawn over highway-env's picture: forecasts dashed, truth thin, edges as wide as they are likely.

Pure drawing: world positions in, RGB out. `envs.render` plays the episode and knows the simulator.
"""

import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

Color = tuple[int, int, int]
Polyline = Float[np.ndarray, "_ 2"]

_SMOOTHING = 2  # lines are drawn this much larger and scaled down
_MARGIN_PX = 8.0


@dataclass(frozen=True)
class OverlayStyle:
    """Colours [RGB] and widths [px of the picture]."""

    forecast_color: Color = (255, 190, 40)
    """Dashed line, a dot per step."""
    forecast_width_px: float = 2.0
    """Width of the dashes."""
    dash_px: float = 7.0
    """Length of a dash; the gap is as long."""
    truth_color: Color = (15, 15, 15)
    """Solid line."""
    truth_width_px: float = 1.5
    """Width of the truth."""
    edge_color: Color = (235, 90, 220)
    """From the ego to an agent."""
    edge_width_px: float = 8.0
    """Width of an edge of probability 1."""
    edge_alpha: int = 150
    """Opacity of edges, 0–255."""
    min_edge_prob: float = 0.02
    """Edges below are not drawn."""
    text_px: int = 15
    """Height of text."""


@dataclass(frozen=True)
class AgentOverlay:
    """What is drawn for one agent; world positions [m]."""

    now_m: tuple[float, float]
    """Where it is in this picture."""
    forecast_m: tuple[Polyline, ...]
    """One line per sample, from where it was when the forecast was made."""
    truth_m: Polyline
    """Where it then went."""
    edge_prob: float
    """Probability that it interacts with the ego."""


@dataclass(frozen=True)
class View:
    """Maps world positions to pixels, as highway-env's surface does but without rounding."""

    origin_m: tuple[float, float]
    """World position of the upper left corner."""
    scaling: float
    """Pixels per metre."""

    def pixels(self, positions_m: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2"]:
        """Pixel positions (x to the right, y down)."""
        return (positions_m - np.array(self.origin_m)) * self.scaling


def draw_overlay(
    picture: Image.Image,
    view: View,
    ego_m: tuple[float, float],
    agents: list[AgentOverlay],
    caption: str,
    style: OverlayStyle,
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture with edges, truth, forecasts, caption and legend over it."""
    size = (picture.width * _SMOOTHING, picture.height * _SMOOTHING)
    overlay = Image.new("RGBA", size, (0, 0, 0, 0))
    pen = _Pen(ImageDraw.Draw(overlay), style)
    ego = view.pixels(np.array([ego_m]))[0]
    for agent in agents:
        if agent.edge_prob >= style.min_edge_prob:
            pen.edge(np.stack([ego, view.pixels(np.array([agent.now_m]))[0]]), agent.edge_prob)
    for agent in agents:
        pen.truth(view.pixels(agent.truth_m))
    for agent in agents:
        for line in agent.forecast_m:
            pen.forecast(view.pixels(line))
    _draw_captions(pen, picture.size, caption)
    smooth = overlay.resize(picture.size, Image.Resampling.BOX)
    result = picture.convert("RGB")
    result.paste(smooth, mask=smooth)
    return np.asarray(result)


def decode_png(data: bytes) -> Image.Image:
    """A picture that was kept compressed."""
    return Image.open(io.BytesIO(data))


def encode_png(pixels: UInt8[np.ndarray, "height width 3"]) -> bytes:
    """Compress a picture; highway-env's flat colours shrink about a hundredfold."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", compress_level=1)
    return buffer.getvalue()


def dashes(line: Polyline, dash: float) -> list[Polyline]:
    """Cut a polyline into dashes of length `dash` with gaps of the same length; corners are kept."""
    lengths = np.hypot(*np.diff(line, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    pieces = []
    for start in np.arange(0.0, along[-1], 2 * dash):
        end = min(start + dash, along[-1])
        inside = along[(along > start) & (along < end)]
        at = np.concatenate([[start], inside, [end]])
        pieces.append(np.stack([np.interp(at, along, line[:, 0]), np.interp(at, along, line[:, 1])], axis=-1))
    return pieces


@dataclass(frozen=True)
class _Pen:
    """Draws in pixels of the picture on the larger overlay."""

    canvas: ImageDraw.ImageDraw
    style: OverlayStyle

    def edge(self, line: Polyline, prob: float) -> None:
        self._line(line, max(1.0, prob * self.style.edge_width_px), (*self.style.edge_color, self.style.edge_alpha))

    def truth(self, line: Polyline) -> None:
        self._line(line, self.style.truth_width_px, (*self.style.truth_color, 255))

    def forecast(self, line: Polyline) -> None:
        color = (*self.style.forecast_color, 255)
        for piece in dashes(line, self.style.dash_px):
            self._line(piece, self.style.forecast_width_px, color)
        radius = 1.2 * self.style.forecast_width_px * _SMOOTHING
        for x, y in line[1:] * _SMOOTHING:
            self.canvas.ellipse((x - radius, y - radius, x + radius, y + radius), fill=color)

    def box(self, left: float, top: float, right: float, bottom: float) -> None:
        corners = [value * _SMOOTHING for value in (left, top, right, bottom)]
        self.canvas.rounded_rectangle(corners, radius=4 * _SMOOTHING, fill=(25, 25, 25, 190))

    def text(self, x: float, y: float, text: str) -> float:
        """Write with the vertical middle at y; returns where the text ends."""
        font = _font(self.style.text_px * _SMOOTHING)
        self.canvas.text((x * _SMOOTHING, y * _SMOOTHING), text, fill=(240, 240, 240, 255), font=font, anchor="lm")
        return x + self.text_width(text)

    def text_width(self, text: str) -> float:
        return self.canvas.textlength(text, font=_font(self.style.text_px * _SMOOTHING)) / _SMOOTHING

    def _line(self, line: Polyline, width: float, color: tuple[int, int, int, int]) -> None:
        if len(line) < 2:
            return
        points = [(float(x), float(y)) for x, y in line * _SMOOTHING]
        self.canvas.line(points, fill=color, width=max(1, round(width * _SMOOTHING)), joint="curve")


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _draw_captions(pen: _Pen, size: tuple[int, int], caption: str) -> None:
    """The caption in the upper left corner, the legend in the lower left one."""
    height = pen.style.text_px + 8.0
    pen.box(_MARGIN_PX, _MARGIN_PX, 3 * _MARGIN_PX + pen.text_width(caption), _MARGIN_PX + height)
    pen.text(2 * _MARGIN_PX, _MARGIN_PX + height / 2, caption)

    legend: tuple[tuple[str, Callable[[Polyline], None]], ...] = (
        ("forecast", pen.forecast),
        ("what happened", pen.truth),
        ("edge to the ego (probability)", lambda line: pen.edge(line, 0.7)),
    )
    sample_px = 34.0
    entry_px = [sample_px + _MARGIN_PX + pen.text_width(name) + 2 * _MARGIN_PX for name, _ in legend]
    top = size[1] - _MARGIN_PX - height
    pen.box(_MARGIN_PX, top, 2 * _MARGIN_PX + sum(entry_px), top + height)
    x, y = 2.0 * _MARGIN_PX, top + height / 2
    for (name, draw), width in zip(legend, entry_px, strict=True):
        draw(np.array([[x, y], [x + sample_px, y]]))
        pen.text(x + sample_px + _MARGIN_PX, y, name)
        x += width
