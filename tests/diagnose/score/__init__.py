"""Tests of single score tests."""
