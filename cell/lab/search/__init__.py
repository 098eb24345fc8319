"""The search for the effects that a model lacks.

A `SearchSetup` says what the search starts from; `FitCache.of` fits the baseline, and the cache
keeps every set of effects that is fitted.  `screen` predicts by a score test what each effect would
explain; the likeliest are fitted (`extension`).  `search_effects` adds the effect with
the most evidence while it is significant and held-out trials confirm it, then exchanges and prunes
(`stepwise`).  Where no set of effects explains the study, `explain_partly` fits all trials jointly,
with the model's own error as noise.  What later stages need is a `SearchResult` or a
`PartialExplanation`.
"""
