"""One law at one place on trial, and the ranking of all of them."""
