"""Colours of the pictures."""

Colour = tuple[int, int, int]

BACKGROUND, ROAD, LANE_LINE = (248, 248, 246), (226, 228, 230), (255, 255, 255)
OTHER, OTHER_GLASS = (138, 154, 176), (94, 108, 130)
