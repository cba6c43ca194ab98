"""Which space beside the object is free? Ask boxes on all sides of it, seen and unseen, of saved hypotheses.

python examples/01_one_frame.py && python examples/02_query_boxes.py out/one_frame/object_1.npz
"""

import sys

import farside

SIDES = {"towards the camera": (1, 0), "left of it": (0, -1), "right of it": (0, 1), "behind it": (-1, 0)}


def main(file: str = "out/one_frame/object_1.npz", risk: float = 0.05) -> dict[str, farside.QueryResult]:
    """Print how likely a 4 cm box on each side of the object is free, and the verdict at a risk."""
    (h,) = scene = farside.load(file)
    middle, half = 0.62 * h.object_frame.half_extent, 0.02  # m; about where a handle would be
    answers = {}
    for name, (x, y) in SIDES.items():
        u, v = middle * x, middle * y  # object frame: x towards the camera, z up
        box = farside.Box((u - half, v - half, -half), (u + half, v + half, half))
        answers[name] = answer = farside.query(scene, box, frame="object")
        print(
            f"{name:>18}: free with {answer.p_free:.2f} +- {answer.p_free_se:.2f},"
            f" {100 * answer.unseen_fraction:.0f}% of it unseen -> {answer.verdict(risk)}"
        )
    return answers


if __name__ == "__main__":
    try:
        main(sys.argv[1]) if sys.argv[1:] else main()
    except (ValueError, OSError) as error:
        raise SystemExit(f"error: {error}") from None
