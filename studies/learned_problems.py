"""What the study of learned lenses looks for, from how many images and starts."""

PROBLEMS = {"xi": ("xi",), "place": ("radius", "x", "y"), "all": ("xi", "radius", "x", "y")}
LOSSES = ("labels", "entropy", "information", "statistics")
IMAGES = dict(xi=(16, 64, 256), place=(256,), all=(256,))  # how many of a camera are used
STARTS = 2  # for each camera
GRID = [k / 40 for k in range(41)]  # of ξ
