"""The problems of the study of learned lenses, with the numbers of images and starts."""

PROBLEMS = {"xi": ("xi",), "place": ("radius", "x", "y"), "all": ("xi", "radius", "x", "y")}
LOSSES = ("labels", "entropy", "information", "statistics")
IMAGES = dict(xi=(16, 64, 256), place=(256,), all=(256,))  # the numbers of images of a camera
STARTS = 2  # per camera
GRID = [k / 40 for k in range(41)]  # values of ξ
