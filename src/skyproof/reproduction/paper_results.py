"""What the paper reports, as numbers to stand beside ours (tables 2 and S3)."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PaperResult:
    """One attack in the paper's tables: means over its three synthetic models, in percent.

    EASR and average precision drop (APD, from the supplement), on its own renderer and on Blender.
    """

    easr: float
    easr_blender: float | None
    apd: float
    apd_blender: float | None
    perturbation_magnitude: float | None = None  # PM*, which maximises P1; None without a shape
    commented: bool = False  # the EASR stands only in the comments of the paper's source


PAPER_RESULTS: dict[str, PaperResult] = {
    "T-U": PaperResult(95.77, 70.02, 50.97, 63.17),
    "T-Ma": PaperResult(75.76, 44.43, 32.68, 40.67),
    "T-Pix": PaperResult(94.75, 63.83, 53.28, 59.03),
    "T-PixMa": PaperResult(73.39, 41.49, 24.20, 37.47, commented=True),
    "T-Lc": PaperResult(92.63, 74.65, 46.17, 64.95, commented=True),
    "T-Fc": PaperResult(37.22, 55.96, 7.54, 48.46, commented=True),
    "T-LcMa": PaperResult(71.93, 52.51, 26.83, 46.80, commented=True),
    "T-FcMa": PaperResult(12.58, 26.43, 2.56, 23.11, commented=True),
    "T-PixLc": PaperResult(96.73, 68.85, 56.30, 62.13, commented=True),
    "T-PixFc": PaperResult(35.68, 55.87, 9.62, 48.92, commented=True),
    "T-PixLcMa": PaperResult(68.39, 42.15, 22.97, 37.59),
    "T-PixFcMa": PaperResult(12.70, 44.64, 2.53, 38.32),
    "R-U": PaperResult(0.88, 16.31, 0.21, 13.69, commented=True),
    "R-Pix": PaperResult(3.86, 18.95, 0.51, 16.77, commented=True),
    "R-Fc": PaperResult(3.30, 18.95, 0.85, 15.82, commented=True),
    "R-PixFc": PaperResult(3.16, 20.24, 0.62, 17.75),
    "S-O": PaperResult(89.82, 78.86, 53.18, 72.47, 0.4),
    "C-U-seq": PaperResult(96.51, None, 55.43, None, 0.0, commented=True),
    "C-Pix-seq": PaperResult(95.02, None, 58.09, None, 0.0, commented=True),
    "C-Lc-seq": PaperResult(92.68, None, 50.49, None, 0.0, commented=True),
    "C-PixLc-seq": PaperResult(96.40, None, 58.13, None, 0.0, commented=True),
    "C-Fc-seq": PaperResult(86.80, 70.37, 18.35, 62.96, 0.2),
    "C-Fc-par": PaperResult(87.11, 68.07, 37.39, 62.57, 0.2),
    "C-PixFc-seq": PaperResult(86.83, 75.76, 36.09, 68.64, 0.2),
    "C-PixFc-par": PaperResult(89.34, 77.86, 37.79, 71.18, 0.2),
}

ON_RENDERER = {name: result.easr for name, result in PAPER_RESULTS.items()}
"""The paper's EASR on its own renderer."""

ON_BLENDER = {
    name: result.easr_blender
    for name, result in PAPER_RESULTS.items()
    if result.easr_blender is not None
}
"""The paper's EASR on Blender, as far as it gives it."""
