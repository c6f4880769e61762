"""Output for people: figures, report sections and the page; a new section is one file in `sections`."""
