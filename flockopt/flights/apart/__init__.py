"""Flights kept apart from each other, by waiting and by detours."""
