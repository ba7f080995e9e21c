"""Draws recordings as one page of plots, without a viewer; needs the extra `plot`.

- `report` makes the page, a `Report`, and saves it as PNG, SVG, PDF or HTML.
- `measure` reads the numbers of episodes, the values of all steps, and the steps of chosen episodes.
  `groups` joins runs that differ only by their seeds. `statistics` computes means, bands and bins.
- `draw_episodes`, `draw_values` and `draw_trace` draw its panels; `texts` writes its head, its notes and the HTML.
- `style` holds the colours, the fonts and the layout.
"""

from tupli_mcap.plots.measure import Measured
from tupli_mcap.plots.report import FORMATS, Report, check_goal, report

__all__ = ["FORMATS", "Measured", "Report", "check_goal", "report"]
