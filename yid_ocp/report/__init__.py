"""The summaries, figures, report sections and HTML page of a run. A new section is one file in `sections`."""
