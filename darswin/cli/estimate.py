"""`darswin lens estimate`: finds a lens from ordinary pictures with straight edges."""

import json
import math
import sys
from collections.abc import Sequence

from darswin.cli.arguments import check_out
from darswin.cli.calibrate import check_lens_out, write_lens
from darswin.utils.files import replace_file
from darswin.utils.parameters import check


def estimate(
    pictures: Sequence[str] = (), *, out: str | None = None, model: str = "auto",
    fov_deg: float | None = None, center: tuple[float, float] | None = None,
    report: str | None = None, accept_doubts: bool = False,
) -> None:  # fmt: skip
    """Estimates a lens from pictures of rooms, houses or streets, without a board.

    Args:
        pictures: pictures of one camera, or folders of them.
        out: the calibration file to write. Its ending names the format, as for `darswin lens
            convert`.
        model: the lens model, a name of darswin.lens.MODELS; Division, an OCam lens with two
            coefficients; or auto: of it, Spherical and KannalaBrandt, the closest to the lines.
        fov_deg: the field of view of the visible image circle in degrees, if you know it.
        center: the principal point x,y in px, if you know it. The default is near the middle.
        report: a JSON file to write, with the lens, its angle at the rim and what supports it.
        accept_doubts: whether to write the calibration although the pictures allow very different
            lenses.
    """
    # These import OpenCV and Pillow, which other commands of `lens` do not need.
    from darswin.calibrate import estimate as estimate_lens
    from darswin.cli.pictures import files_at
    from darswin.utils.image import read_stored

    if not pictures:
        raise ValueError("missing pictures: give files or folders")
    if fov_deg is not None:
        check("fov_deg", fov_deg, 0 < fov_deg < 360, "above 0° and below 360°")
    files = [file.name for file in files_at(pictures) if not file.is_video]
    if not files:
        raise ValueError(f"no pictures in {', '.join(pictures)}")
    check_lens_out(out, files)
    check_out(report, files, "report")
    estimated = estimate_lens(
        [read_stored(file) for file in files],
        model,
        center=center,
        fov=None if fov_deg is None else math.radians(fov_deg),
        progress=lambda line: print(line, file=sys.stderr),
    )
    print(estimated.verdict)
    for doubt in estimated.doubts:
        print(f"doubt: {doubt}")
    if report is not None:
        replace_file(report, json.dumps(estimated.to_dict() | {"pictures": files}, indent=1) + "\n")
    if out is not None and not (estimated.is_sure or accept_doubts):
        raise ValueError(
            f"{out} is not written, because the pictures allow very different lenses: give more "
            "pictures, --fov_deg of the image circle, or --accept_doubts true"
        )
    if out is not None:
        write_lens(estimated.lens, out, None)
