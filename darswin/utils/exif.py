"""The orientations that EXIF gives pictures (EXIF 2.3, tag 0x0112)."""

# How a stored picture becomes upright: (swap x and y, then mirror x, then mirror y).
TURNS = {
    1: (False, False, False),
    2: (False, True, False),
    3: (False, True, True),
    4: (False, False, True),
    5: (True, False, False),
    6: (True, True, False),
    7: (True, True, True),
    8: (True, False, True),
}
