"""What can go wrong, made to go wrong, many times: the tests run each check briefly, ``make torture`` at full length.

A check is a function of the number of trials that gives an `Outcome`; R numbers are those of docs/trust.md.
"""
