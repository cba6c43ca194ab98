"""What stands there: objects found in real frames without their label maps, beside the labels.

The frames are read from ../shared/data beside the checkout (`benchmarks.scenes.real_frames`). A labelled thing is found
where one segment has an IoU of 0.5 or more with its label. A segment that is of no labelled thing is another thing
where most of its pixels lie in the box of one that was listed before; otherwise it is wrongly found. For the frame
without a label map the listed things must be found, by their boxes. The rules of `segment` were developed on these
frames.

- found: labelled (or listed) things that were found, of all. missed: the others, with the reason where they were left
  out. iou: of the found ones.
- seconds: `segment` of one frame, its file read before.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from benchmarks.harness.rows import Row
from benchmarks.harness.study import Summary, TableOptions
from benchmarks.harness.tables import Table, gated
from benchmarks.scenes.real_frames import Box, RealFrame, frames
from perception.observation.segmentation import Segments, segment
from perception.sources.frame import Frame

FOUND_IOU = 0.5
AIMS = {"found": 0.9, "iou": 0.8, "wrong": 1.0}


@dataclass(frozen=True)
class Options(TableOptions):
    """Objects found in real frames without their label maps, beside the labels."""


@dataclass(frozen=True)
class Judged:
    """What was found in one frame."""

    frame: str
    iou: dict[str, float]  # of each thing that was found
    missed: dict[str, str]  # the reason
    others: int
    wrong: int
    left_out: int
    seconds: float


def main(options: Options) -> Summary:
    """Measure, and sum up."""
    judged = []
    for name, real, frame in list(frames())[: 1 if options.quick else None]:
        bare = replace(frame, label=None)
        begun = time.monotonic()
        found = segment(bare)
        judged.append(judge(name, real, frame, found, time.monotonic() - begun))
    return Summary(_rows(judged), [_table(judged)])


def judge(name: str, real: RealFrame, frame: Frame, found: Segments, seconds: float = 0.0) -> Judged:
    """A frame's segments beside its labels and the list of what else stands there."""
    iou, missed, used = dict[str, float](), dict[str, str](), set[int]()
    for label, thing in real.things.items():
        assert frame.label is not None
        mask, title = frame.label == label, f"{label} {thing}"
        overlaps = [_iou(s.mask, mask) for s in found]
        best = int(np.argmax(overlaps)) if overlaps else -1
        if best >= 0 and overlaps[best] >= FOUND_IOU:
            iou[title] = overlaps[best]
            used.add(best)
            continue
        left = [it.reason for it in found.left_out if _iou(it.mask, mask) >= FOUND_IOU]
        missed[title] = left[0] if left else f"best IoU {max(overlaps, default=0.0):.2f}"
    rest = [s.mask for i, s in enumerate(found) if i not in used]
    listed = {title: [mask for mask in rest if _in_box(mask, box)] for title, box in real.others.items()}
    others = {id(mask) for masks in listed.values() for mask in masks}
    if not real.things:
        missed |= {title: "no segment in its box" for title, masks in listed.items() if len(masks) != 1}
        iou |= {title: float("nan") for title, masks in listed.items() if len(masks) == 1}
    more = len(others) if real.things else len(others) - len(iou)
    return Judged(name, iou, missed, more, len(rest) - len(others), len(found.left_out), seconds)


def _iou(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"]) -> float:
    return float((a & b).sum() / (a | b).sum())


def _in_box(mask: Bool[np.ndarray, "h w"], box: Box) -> bool:
    x0, y0, x1, y1 = box
    return bool(mask[y0:y1, x0:x1].sum() > 0.5 * mask.sum())


def _rows(judged: Sequence[Judged]) -> list[Row]:
    rows = []
    for j in judged:
        known = [value for value in j.iou.values() if not np.isnan(value)]
        n = len(j.iou) + len(j.missed)
        values = {"found": len(j.iou) / n, "wrong": float(j.wrong), "others": float(j.others), "seconds": j.seconds}
        if known:
            values |= {"iou": float(np.mean(known)), "iou_worst": min(known)}
        rows += [Row("segmentation", "segment", j.frame, k, v, "s" * (k == "seconds"), n) for k, v in values.items()]
    return rows


def _table(judged: Sequence[Judged]) -> Table:
    lines = []
    for j in judged:
        known = {title: value for title, value in j.iou.items() if not np.isnan(value)}
        worst = min(known, key=lambda title: known[title]) if known else ""
        lines.append(
            [
                j.frame,
                f"{len(j.iou)} of {len(j.iou) + len(j.missed)}",
                f"{np.mean(list(known.values())):.2f}" if known else "",
                f"{known[worst]:.2f} ({worst})" if known else "",
                gated(str(j.wrong), j.wrong, most=AIMS["wrong"]),
                str(j.others),
                str(j.left_out),
                "; ".join(f"{title}: {why}" for title, why in j.missed.items()) or "none",
            ]
        )
    n = sum(len(j.iou) + len(j.missed) for j in judged)
    found = sum(len(j.iou) for j in judged)
    every = [value for j in judged for value in j.iou.values() if not np.isnan(value)]
    lines.append(
        [
            "all",
            gated(f"{found} of {n}", found / n, least=AIMS["found"]),
            gated(f"{np.mean(every):.3f}", float(np.mean(every)), least=AIMS["iou"]),
            f"{min(every):.2f}",
            str(sum(j.wrong for j in judged)),
            str(sum(j.others for j in judged)),
            str(sum(j.left_out for j in judged)),
            f"{sum(len(j.missed) for j in judged)}",
        ]
    )
    header = (
        "frame", "found, gate >= 90%", "mean IoU, gate >= 0.8", "worst IoU", "wrongly found, gate <= 1",
        "other things", "left out", "missed",
    )  # fmt: skip
    return Table("Real frames without their label maps", header, lines)
