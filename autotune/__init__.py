"""The tool: command line, simulated cell, solvers, certificates and files."""

__version__ = "0.1.0"

__all__ = ["__version__"]
