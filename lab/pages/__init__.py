"""Rows of docs/results/ in; the results page and the README's evaluation block out: `python -m lab.pages`."""
