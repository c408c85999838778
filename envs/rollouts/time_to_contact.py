"""Time to contact: when rectangles that keep their velocities and headings first touch.

Two convex bodies overlap exactly while their projections overlap on the normals of all their sides. Each projection
moves at a constant rate, so it overlaps during one interval, and the contact begins when the last interval does. The
result is exact; `envs.plans.contact` instead compares bodies along forecast paths, at a few instants of each step.
"""

import numpy as np
from jaxtyping import Float


def times_to_contact(
    offset_m: Float[np.ndarray, "others 2"],
    velocity_mps: Float[np.ndarray, "others 2"],
    heading_rad: float,
    headings_rad: Float[np.ndarray, " others"],
    size_m: Float[np.ndarray, " 2"],
    sizes_m: Float[np.ndarray, "others 2"],
) -> Float[np.ndarray, " others"]:
    """Computes after which time each other body touches the ego [s].

    Args:
        offset_m: centre of each other body minus the ego's [m].
        velocity_mps: velocity of each other body minus the ego's [m/s].
        heading_rad: heading of the ego [rad].
        headings_rad: heading of each other body [rad].
        size_m: length and width of the ego [m].
        sizes_m: length and width of each other body [m].

    Returns:
        0 for bodies that overlap already, infinity for those that never touch.
    """
    count = len(offset_m)
    axes_rad = np.stack([np.broadcast_to(heading_rad, count), headings_rad])  # along the ego, along the other
    axes_rad = np.concatenate([axes_rad, axes_rad + np.pi / 2])  # and across them
    reach_m = _half_widths(axes_rad, np.broadcast_to(heading_rad, count), np.broadcast_to(size_m, (count, 2)))
    reach_m = reach_m + _half_widths(axes_rad, headings_rad, sizes_m)
    cos, sin = np.cos(axes_rad), np.sin(axes_rad)
    apart_m = cos * offset_m[:, 0] + sin * offset_m[:, 1]
    rate_mps = cos * velocity_mps[:, 0] + sin * velocity_mps[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds_s = np.sort(np.stack([-reach_m - apart_m, reach_m - apart_m]) / rate_mps, axis=0)
    overlapping = np.abs(apart_m) <= reach_m
    enter_s = np.where(rate_mps == 0, np.where(overlapping, -np.inf, np.inf), bounds_s[0]).max(axis=0)
    leave_s = np.where(rate_mps == 0, np.where(overlapping, np.inf, -np.inf), bounds_s[1]).min(axis=0)
    touch = (enter_s <= leave_s) & (leave_s >= 0)
    return np.where(touch, enter_s.clip(min=0.0), np.inf)


def _half_widths(
    axes_rad: Float[np.ndarray, "axes others"],
    headings_rad: Float[np.ndarray, " others"],
    sizes_m: Float[np.ndarray, "others 2"],
) -> Float[np.ndarray, "axes others"]:
    """Returns half the extent of each body along each axis [m]."""
    between = axes_rad - headings_rad
    extent: Float[np.ndarray, "axes others"] = np.abs(np.cos(between)) * sizes_m[:, 0]
    return (extent + np.abs(np.sin(between)) * sizes_m[:, 1]) / 2
