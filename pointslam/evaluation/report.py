"""report.html: one page that needs nothing else, with figures, plots and pictures."""

from __future__ import annotations

import base64
import html
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 1240px; color: #222;
  padding: 0 1rem; }
main { display: grid; gap: 1.5rem; align-items: start;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 30rem), 1fr)); }
h2 { margin: 2.5rem 0 1rem; }
table { border-collapse: collapse; width: 100%; }
td { padding: .2rem .9rem .2rem 0; vertical-align: top; border-bottom: 1px solid #ddd; }
td:first-child { color: #666; white-space: nowrap; }
td:nth-child(2) { font-variant-numeric: tabular-nums; }
figure { margin: 0; } img { width: 100%; display: block; }
figcaption { display: flex; color: #666; } figcaption span { flex: 1; }
"""


@dataclass(frozen=True)
class Row:
    """One line of the table: what, how much (already formatted), in which unit."""

    name: str
    value: str


def table_rows(metrics: dict[str, Any]) -> list[Row]:
    """The figures that people look at first; `-` where there is none."""
    wall, anchors = metrics["wall_s"], metrics["anchors"]
    unanswered = metrics["frames"] - metrics["tracked"] - metrics["lost"]  # superseded, too early
    counts = f"{metrics['tracked']} of {metrics['frames']}, {metrics['lost']} lost"
    counts += f", {unanswered} without an answer" if unanswered else ""
    rows = [
        Row("sequence", f"{metrics['sequence']} ({metrics['mode']})"),
        Row("frames tracked", f"{counts}, {metrics['relocalized']} relocalized"),
        Row("keyframes", _text(metrics["keyframes"], "{:d}")),
        Row("loops closed", _text(metrics.get("loops"), "{:d}")),
        Row("ATE online / final", _pair(metrics, "ate_online_rmse_m", "ate_final_rmse_m")),
        Row("RPE over 30 frames", _relative(metrics)),
    ]
    rows += [_image_row(metrics, name) for name in ("all", "heldout", "novel", "gsicp")]
    rows += [
        Row("tracking", _median(metrics["tracking_ms"], "ms a frame (median), ")),
        Row("mapping", _mapping(metrics)),
        Row("anchors", f"{anchors['primary']} primary, {anchors['secondary']} secondary"),
        Row("map", _text(metrics["map_mb"], "{:.1f} MB")),
        Row("peak memory", _memory(metrics["peak_rss_mb"])),
        Row("wall time", f"{wall['total']:.1f} s, {metrics['input_fps']:.1f} frames/s"),
    ]
    return rows


def text_table(metrics: dict[str, Any]) -> str:
    """The table for a terminal."""
    rows = table_rows(metrics)
    width = max(len(row.name) for row in rows)
    return "\n".join(f"{row.name:<{width}}  {row.value}" for row in rows)


def write_report(
    path: Path, metrics: dict[str, Any], plots: list[bytes], pictures: list[Path]
) -> None:
    """Write the page; pictures are files of rendered beside true."""
    rows = "".join(
        f"<tr><td>{html.escape(row.name)}</td><td>{html.escape(row.value)}</td></tr>"
        for row in table_rows(metrics)
    )
    figures = "".join(_figure("image/png", data, ()) for data in plots)
    views = "".join(
        _figure("image/jpeg", _jpeg(picture), (f"{_view_name(picture)}: rendered", "truth"))
        for picture in pictures
    )
    title = html.escape(f"PointSLAM++: {metrics['sequence']}")
    path.write_text(
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{_STYLE}</style></head><body><h1>{title}</h1><main><table>{rows}</table>"
        f"{figures}</main><h2>Views</h2><main>{views}</main></body></html>\n"
    )


def _figure(kind: str, data: bytes, captions: tuple[str, ...]) -> str:
    """An image; its captions share its width."""
    source = f"data:{kind};base64,{base64.b64encode(data).decode()}"
    spans = "".join(f"<span>{html.escape(caption)}</span>" for caption in captions)
    return f'<figure><img src="{source}" alt=""><figcaption>{spans}</figcaption></figure>'


def _view_name(picture: Path) -> str:
    kind, _, number = picture.stem.partition("_")
    words = {"frame": "held-out frame", "novel": "novel view"}
    return f"{words.get(kind, kind)} {int(number)}"


def _jpeg(picture: Path) -> bytes:
    image = cv2.imread(str(picture))
    assert image is not None, picture
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes()


def _text(value: float | int | None, form: str) -> str:
    return "-" if value is None else form.format(value)


def _pair(metrics: dict[str, Any], first: str, second: str) -> str:
    centimetres = [None if metrics[k] is None else 100 * metrics[k] for k in (first, second)]
    return " / ".join(_text(value, "{:.2f} cm") for value in centimetres)


def _relative(metrics: dict[str, Any]) -> str:
    translation_m, rotation_deg = metrics["rpe30_trans_m"], metrics["rpe30_rot_deg"]
    if translation_m is None:
        return "-"
    return f"{1000 * translation_m:.1f} mm, {rotation_deg:.2f} deg"


def _image_row(metrics: dict[str, Any], name: str) -> Row:
    block = metrics[name]
    parts = [_text(block["psnr_db"], "{:.2f} dB"), _text(block["ssim"], "SSIM {:.3f}")]
    if block.get("depth_l1_m") is not None:
        parts.append(f"depth {100 * block['depth_l1_m']:.1f} cm")
    if block.get("seen") is not None:
        parts.append(f"{100 * block['seen']:.0f} % seen")
        parts.append(_text(block["psnr_seen_db"], "{:.2f} dB there"))
    return Row(f"images, {name}", "-" if block["psnr_db"] is None else ", ".join(parts))


def _median(times: dict[str, Any], unit: str) -> str:
    if times["median"] is None:
        return "-"
    return f"{times['median']:.1f} {unit}{times['p95']:.1f} ms (p95)"


def _mapping(metrics: dict[str, Any]) -> str:
    iterations, median = (
        metrics["mapping_iterations"],
        metrics["mapping_ms_per_iteration"]["median"],
    )
    return f"{iterations} iterations, {_text(median, '{:.1f} ms')} each (median)"


def _memory(peak: dict[str, float | None]) -> str:
    known = {role: value for role, value in peak.items() if value is not None}
    if not known:
        return "-"
    parts = ", ".join(f"{role} {value:.0f}" for role, value in known.items())
    return f"{sum(known.values()):.0f} MB ({parts})"
