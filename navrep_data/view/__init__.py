"""One self-contained HTML page that plays a dataset's sequences or shows a benchmark's trajectories. No torch."""

from navrep_data.view.dataset import DEFAULT_SEQUENCES, dataset_page
from navrep_data.view.page import DEFAULT_MAX_BYTES, Page
from navrep_data.view.results import Scene, is_results, results_page

__all__ = ["DEFAULT_MAX_BYTES", "DEFAULT_SEQUENCES", "Page", "Scene", "dataset_page", "is_results", "results_page"]
