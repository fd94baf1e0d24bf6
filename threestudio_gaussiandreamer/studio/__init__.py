"""The studio: a page that starts runs, shows them growing, and keeps, compares and exports them."""
