"""The paper's claims, their verdicts and reports."""
