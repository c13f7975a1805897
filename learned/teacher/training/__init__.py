"""How allocators learn: what on, how judged, how told."""
