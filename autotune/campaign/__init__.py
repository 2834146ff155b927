"""Many logs of many cells: identify and tune each once, and compare cells with each other and with their past."""
