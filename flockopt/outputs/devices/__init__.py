"""Plans as the files that real drones fly from."""
