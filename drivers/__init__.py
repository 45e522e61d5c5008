"""Buses, drives and cameras: builds and parses what goes over the wire, decides nothing."""
