"""What shows that the method works: things made once, tables, and the paper's claims.

The library is below and knows nothing of this package.
"""
