"""What every record stands on: arrays, checks of values, files."""
