"""What people read and look at: figures, report sections and the page; a new section is one file in `sections`."""
