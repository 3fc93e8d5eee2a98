"""Figures as functions, and the builder of self-contained pages."""

from ._figures import delay_figure as delay_figure
from ._figures import loop_figure as loop_figure
from ._figures import recording_figure as recording_figure
from ._figures import validation_figure as validation_figure
from ._neck3d import neck_view as neck_view
from ._page import Section as Section
from ._page import Table as Table
from ._page import figure_png as figure_png
from ._page import page as page
from ._page import write_page as write_page
from ._quality_figures import correlation_figure as correlation_figure
from ._quality_figures import faults_figure as faults_figure
from ._quality_figures import histogram_figure as histogram_figure
from ._quality_figures import region_figure as region_figure
from ._quality_figures import spectrum_figure as spectrum_figure
from ._quality_page import quality_page as quality_page
