"""Flights made quicker and smoother, stage by stage, by a solver or by what somebody proposes."""
