"""Tests of campaigns through the command line."""
