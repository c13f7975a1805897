"""Any-angle distances between starts, tasks and ends, and the paths behind them."""

from flockopt.travel.travel import END, START, Paths, Travel

__all__ = ["END", "START", "Paths", "Travel"]
