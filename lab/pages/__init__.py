"""Rows of lab/rows/ in; the results page and the README's evaluation block out: `python -m lab.pages`."""
