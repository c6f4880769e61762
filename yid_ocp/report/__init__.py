"""Figures, report sections and the HTML page. A new section is one file in `sections`."""
