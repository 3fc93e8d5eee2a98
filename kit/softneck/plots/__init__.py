"""Charts as plain data, drawn as matplotlib figures or interactively, and the builder of self-contained pages."""

from ._chart import Chart as Chart
from ._chart import Curve as Curve
from ._chart import Level as Level
from ._chart import Panel as Panel
from ._charts import delay_chart as delay_chart
from ._charts import loop_chart as loop_chart
from ._charts import recording_chart as recording_chart
from ._charts import validation_chart as validation_chart
from ._figures import delay_figure as delay_figure
from ._figures import loop_figure as loop_figure
from ._figures import recording_figure as recording_figure
from ._figures import validation_figure as validation_figure
from ._matplotlib import chart_figure as chart_figure
from ._neck3d import neck_view as neck_view
from ._page import Section as Section
from ._page import Table as Table
from ._page import figure_png as figure_png
from ._page import page as page
from ._page import write_page as write_page
from ._timeline import Timeline as Timeline
from ._timeline import timeline as timeline
