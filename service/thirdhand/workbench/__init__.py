"""Tools for the work beside a running cell: teaching, viewing, measuring, setting up."""
