"""Rounds of training: server and client as state machines over bytes and time."""
