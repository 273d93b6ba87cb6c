"""Proximity, contact set, contact law, and one contact iteration."""
