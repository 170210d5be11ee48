"""Figures of the parts that decide how fast and how right an answer is: one module for each command of the tool."""
