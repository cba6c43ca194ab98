"""What a pixel says about an object: nothing, that its ray ends on it, or that its ray misses it."""

UNKNOWN, OBJECT, FREE = 0, 1, 2
