"""`python -m lab.pages` writes the results page and the README's evaluation block from the rows in lab/rows/."""
