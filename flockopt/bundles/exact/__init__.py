"""Proven optima: ng-route duals, enumeration of routes, HiGHS."""
