"""Which space beside the object is free? Ask boxes on all sides of it, seen and unseen, of saved hypotheses.

python examples/01_one_frame.py && python examples/02_query_boxes.py out/one_frame/object_1.npz
"""

import sys

import farside

SIDES = {"towards the camera": (1, 0), "left of it": (0, -1), "right of it": (0, 1), "behind it": (-1, 0)}


def main(
    file: str = "out/one_frame/object_1.npz", risk: float = 0.05, distance: float = 0.85
) -> dict[str, farside.QueryResult]:
    """Print how likely a box right beside the object's body is free, on each side, and the verdict at a risk."""
    scene = farside.load(file)
    if len(scene) != 1:
        raise ValueError(f"{file} holds {len(scene)} objects; give the file of one")
    (h,) = scene
    # In half extents the body reaches to 0.7 at most and the cube to 1: a handle would be between.
    middle, half = distance * h.object_frame.half_extent, 0.1 * h.object_frame.half_extent  # m
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
