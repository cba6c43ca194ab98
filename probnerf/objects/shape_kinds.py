"""What kind of thing an object is, in words that people ask with."""

import re

_VESSELS = frozenset(
    "mug cup bowl bottle jar vase pot goblet beaker flask glass wineglass can canned jug pitcher tankard kettle teapot"
    " chalice bucket basket tin pan amphora urn carafe barrel pottery bin tub ramekin tumbler".split()
)
_BOXES = frozenset("box foodbox book brick crate carton chest case".split())


def kind_of_name(name: str) -> str:
    """The kind of a mesh by the words of its file's name (`plastic_bottle_01`, `FoodBox_7`); "other" if none tells."""
    words = set(re.findall(r"[a-z]+", name.lower()))
    return "vessel" if words & _VESSELS else "box" if words & _BOXES else "other"
