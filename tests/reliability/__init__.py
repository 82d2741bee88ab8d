"""Reliability checks: faults injected many times. The tests run each briefly, ``make reliability``
at full length.

A check is a function of the number of trials that gives an `Outcome`; R numbers are those of
docs/reliability.md.
"""
