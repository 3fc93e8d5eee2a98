"""Figures as functions, and the builder of self-contained pages."""

from ._figures import delay_figure as delay_figure
from ._figures import loop_figure as loop_figure
from ._figures import recording_figure as recording_figure
from ._figures import validation_figure as validation_figure
from ._linear_figures import convergence_figure as convergence_figure
from ._linear_figures import cover_figure as cover_figure
from ._linear_figures import local_map_figure as local_map_figure
from ._neck3d import neck_view as neck_view
from ._page import Section as Section
from ._page import Table as Table
from ._page import figure_png as figure_png
from ._page import page as page
from ._page import write_page as write_page
