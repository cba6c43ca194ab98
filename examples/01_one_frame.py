"""From one view to whole shapes: infer the objects of a frame, look at what was found, keep it.

python examples/01_one_frame.py              # the recording that ships with Farside
python examples/01_one_frame.py my_frame/    # a frame folder or a recording
"""

import sys

import farside


def main(source: str | None = None, out: str = "out/one_frame", budget_s: float = 60.0) -> farside.Scene:
    """Infer all objects of the first frame and print what is known of each."""
    frame = farside.read_frame(source)
    # From arrays of your own: farside.Frame(rgb, depth, K), with rgb uint8[h, w, 3], depth in metres along z (NaN or 0
    # where unknown), K the 3x3 camera matrix in pixels.
    scene = farside.estimate(frame, budget_s=budget_s)
    for h in scene:
        vertices, triangles = farside.meshes(h, 1)[0]  # of the heaviest hypothesis, metres, object frame
        size = 100 * (vertices.max(axis=0) - vertices.min(axis=0))
        print(
            f"object {h.object_id}: {len(h.weights)} hypotheses ({h.effective_hypotheses:.0f} effective);"
            f" the heaviest is {size[0]:.0f} x {size[1]:.0f} x {size[2]:.0f} cm with {len(triangles)} triangles"
        )
        if h.out_of_model:
            print("  no shape of the prior explains this view: its answers are cautious")
    for object_id, reason in scene.left_out.items():
        print(f"object {object_id} is left out: {reason}")
    print("written:", *farside.save(out, scene, frame))
    return scene


if __name__ == "__main__":
    try:
        main(sys.argv[1] if sys.argv[1:] else None)
    except (ValueError, OSError) as error:
        raise SystemExit(f"error: {error}") from None
