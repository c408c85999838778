"""Metrics and scores of forecasts, graphs and edge features."""
