"""Pictures of recordings without a viewer: `report` makes one page, as PNG, SVG or HTML. Needs the extra `plot`."""

from tupli_mcap.plots.gather import Measured
from tupli_mcap.plots.report import FORMATS, Report, check_goal, report

__all__ = ["FORMATS", "Measured", "Report", "check_goal", "report"]
