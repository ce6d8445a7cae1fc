"""Agents: policies and observers made of estimators or networks, one folder per kind of world."""
