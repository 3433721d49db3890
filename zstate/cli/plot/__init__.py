"""zstate plot: numbers over time, as a picture."""
