"""The search for the effects that a model lacks.

A `SearchSetup` says what the search starts from; `FitCache.of` fits the baseline, and the cache
keeps every set of effects that is fitted.  A score test (`cell.lab.fit.score_test`) predicts what
each effect would explain; the likeliest are fitted (`extension`).  `search_effects` adds the effect
with the most evidence while it is significant and held-out trials confirm it (`effect_search`, with
the limits of `cell.lab.data.rules`), then exchanges and prunes (`stepwise`).  If the noise given
the result differs, `FitCache.noise_reestimated` begins the search anew.  Where no set of effects
explains the study, `explain_partly` fits all trials jointly, with the model's own error as noise.
The result is a `SearchResult` or a `PartialExplanation`.
"""
