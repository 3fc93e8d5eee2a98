from ._chart import Chart as Chart
from ._chart import Curve as Curve
from ._chart import Level as Level
from ._chart import Panel as Panel
from ._chart import chart_figure as chart_figure
from ._charts import pareto_figure as pareto_figure
from ._charts import validation_figure as validation_figure
from ._page import Section as Section
from ._page import Table as Table
from ._page import page as page
from ._page import write_page as write_page
from ._recording_pages import quality_page as quality_page

# isort: split
# Shared with other subpackages of softneck; not in the reference, and may change.
from ._chart import BLUE as BLUE
from ._chart import GREEN as GREEN
from ._chart import GREY as GREY
from ._chart import MOTOR_COLOURS as MOTOR_COLOURS
from ._chart import ORANGE as ORANGE
from ._chart import curve_styles as curve_styles
from ._chart import in_display_unit as in_display_unit
from ._chart import signals_figure as signals_figure
from ._charts import cover_chart as cover_chart
from ._charts import distribution_chart as distribution_chart
from ._charts import frequency_response_chart as frequency_response_chart
from ._charts import influence_chart as influence_chart
from ._charts import loop_chart as loop_chart
from ._charts import pareto_chart as pareto_chart
from ._charts import recording_chart as recording_chart
from ._charts import residual_chart as residual_chart
from ._charts import validation_chart as validation_chart
from ._page import Script as Script
from ._page import cell as cell
from ._recording_pages import import_page as import_page
from ._recording_pages import refused_page as refused_page
