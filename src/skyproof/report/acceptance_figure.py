"""What a test does with better and worse detectors: its operating characteristic."""

import matplotlib.pyplot as plt

from skyproof.report.figures import BLUE, GREY, ORANGE, STYLE, as_svg
from skyproof.results.statistics.acceptance import Requirement
from skyproof.results.statistics.compliance import DecisionChances


def chances_figure(chances: DecisionChances, requirement: Requirement) -> str:
    """Draws the chances of both answers against the share lost, with the requirement's points."""
    with plt.rc_context(STYLE | {"svg.hashsalt": "acceptance"}):
        figure, axes = plt.subplots(figsize=(7.2, 3.4), layout="constrained")
        share = 100 * chances.shares
        undecided = 1 - chances.accepted - chances.rejected
        axes.plot(share, 100 * chances.accepted, color=BLUE, linewidth=2.2, label="accepted")
        axes.plot(
            share, 100 * chances.rejected, "--", color=ORANGE, linewidth=2.2, label="rejected"
        )
        axes.plot(share, 100 * undecided, ":", color=GREY, linewidth=2.0, label="undecided")
        for limit, risk, marker, colour in (
            (requirement.accept, requirement.producer_risk, "v", ORANGE),
            (requirement.reject, requirement.consumer_risk, "v", BLUE),
        ):
            axes.axvline(100 * limit, color="#c6cdd4", linewidth=1, zorder=0)
            axes.plot([100 * limit], [100 * risk], marker, color=colour, markersize=8)
        axes.set_xlim(0, min(100, 250 * requirement.reject))
        axes.set_ylim(-2, 102)
        axes.set_xlabel("% of the found vehicles that the detector loses")
        axes.set_ylabel("% of such tests")
        axes.grid(color="#e3e7eb")
        axes.legend(fontsize=10, loc="center right")
        return as_svg(figure)
