"""Tables of benchmarks: what runs on what, which numbers, and what others have published."""

from laser_slam.benchmarks.grid import Cell, Grid, Row, fill_grids
from laser_slam.benchmarks.material import Material
from laser_slam.benchmarks.outcome import Outcome
from laser_slam.benchmarks.overview import list_groups, list_rows, list_sequences, list_tables
from laser_slam.benchmarks.page import Report, put_on_page, save_table
from laser_slam.benchmarks.printing import print_grids
from laser_slam.benchmarks.runner import Bench
from laser_slam.benchmarks.settings import Setting, parse_settings
from laser_slam.benchmarks.table import Table, load_table, table_names
from laser_slam.benchmarks.written import as_csv, as_markdown

__all__ = [
    "Bench",
    "Cell",
    "Grid",
    "Material",
    "Outcome",
    "Report",
    "Row",
    "Setting",
    "Table",
    "as_csv",
    "as_markdown",
    "fill_grids",
    "list_groups",
    "list_rows",
    "list_sequences",
    "list_tables",
    "load_table",
    "parse_settings",
    "print_grids",
    "put_on_page",
    "save_table",
    "table_names",
]
