"""Verdicts and effects of the ledger of functions against the table that the rules in TOML gave: a comparison made once.

PYTHONPATH=$PWD python benchmarks/settings/compare_claims.py
"""

import io, subprocess, sys, time
import numpy as np, pandas as pd
from tsmlib.study.claims import evaluate
from tsmlib.study.claims.ledger import claims

old = pd.read_csv(
    io.StringIO(
        subprocess.run(
            ["git", "show", "7a0498a:data/results/08_claims.csv"], capture_output=True, text=True, check=True
        ).stdout
    ),
    keep_default_na=False,
)
for c in ("value", "low", "high", "margin", "level"):
    old[c] = pd.to_numeric(old[c], errors="coerce")
bad = n = same_order = ends = 0
words = {}
worst_v = worst_e = 0.0
for subject in ("tsm", "tsm+energy+direct"):
    t = time.time()
    ledger = claims(subject)
    rows = evaluate.tables(ledger)
    new = pd.DataFrame(evaluate.as_rows([evaluate.judge(c, rows) for c in ledger], scale="paper"))
    print(subject, len(new), f"{time.time() - t:.1f} s")
    for c in ("value", "low", "high"):
        new[c] = pd.to_numeric(new[c])
    o = old[old.model == subject]
    for cid in dict.fromkeys([*o.claim, *new.claim]):
        a, b = o[o.claim == cid], new[new.claim == cid]
        va, vb = a.verdict.iloc[0], b.verdict.iloc[0]
        words[va, vb] = words.get((va, vb), 0) + 1
        if va != vb and cid not in ("C14", "C49"):
            print("VERDICT", subject, cid, va, vb)
            bad += 1
        for reading in dict.fromkeys([*a.reading, *b.reading]):
            key = ["margin", "level", "value", "low"]
            x, y = (f[f.reading == reading].sort_values(key).reset_index(drop=True) for f in (a, b))
            if len(x) != len(y):
                print("COUNT", subject, cid, reading, len(x), len(y))
                bad += 1
                continue
            for (_, p), (_, q) in zip(x.iterrows(), y.iterrows()):
                n += 1
                ok = p.margin == q.margin and p.level == q.level and p.state == q.state and p.n == q.n
                for c, tol in (("value", 1e-9), ("low", 1e-2), ("high", 1e-2)):
                    if np.isnan(p[c]) != np.isnan(q[c]):
                        ok = False
                    elif not np.isnan(p[c]):
                        d = abs(p[c] - q[c]) / max(abs(p[c]), 1e-300) if p[c] != q[c] else 0.0
                        if c == "value":
                            worst_v = max(worst_v, d)
                        else:
                            worst_e = max(worst_e, d)
                            ends += 1
                        if d > tol:
                            # an interval end near zero: relative to the half width
                            if c != "value" and abs(p[c] - q[c]) <= tol * abs(p.high - p.low) / 2:
                                continue
                            ok = False
                if not ok:
                    bad += 1
                    print(
                        "EFFECT",
                        subject,
                        cid,
                        reading,
                        p.check,
                        "|",
                        q.check,
                        p[["value", "low", "high", "n", "state"]].tolist(),
                        q[["value", "low", "high", "n", "state"]].tolist(),
                    )
print(
    f"{n} effects, {ends} interval ends, {bad} differences; worst relative difference of a value {worst_v:.1e}, of an interval end {worst_e:.1e}"
)
for k, v in sorted(words.items()):
    print(f"{v:4d}  {k[0]} -> {k[1]}")
