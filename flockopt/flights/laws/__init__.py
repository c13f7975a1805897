"""Laws of motion along waypoints: fly-through, ruckig's profiles, the paper's quintic decoder."""
