"""The paper's 54 claims: what each says (``ledger.toml``), and what comparisons find."""
