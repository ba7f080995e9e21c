"""Draws recordings as one page of plots, without a viewer; needs the extra `plot`.

- `report` makes the page, a `Report`, and saves it as PNG, SVG, PDF or HTML.
- `measure` reads what it shows: numbers of episodes, values of all steps, and chosen episodes step by step.
  `groups` puts runs together that differ by their seeds only. `statistics` sums them up.
- `draw_episodes`, `draw_values` and `draw_trace` draw its panels; `texts` writes its head, its notes and the HTML.
- `style` holds colours, fonts and the layout of all of them.
"""

from tupli_mcap.plots.measure import Measured
from tupli_mcap.plots.report import FORMATS, Report, check_goal, report

__all__ = ["FORMATS", "Measured", "Report", "check_goal", "report"]
