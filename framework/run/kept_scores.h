// Scores of a whole split, kept in the run's folder beside those of its training.
#pragma once

#include <string>

#include "core/error.h"
#include "run/metrics_log.h"
#include "run/open_run.h"
#include "run/run_listener.h"

namespace semfield {

/// A row of metrics.jsonl for a scored part of `split`, "test" or "train".
MetricsRow score_row(std::int64_t step, double train_s, const std::string& split, const ScoredPart& part,
                     const SplitScore& score, const ClassTable& classes);

/// Adds what the labels that trained are worth against the scene's own, on these frames.
void add_given_scores(MetricsRow& row, const Session& session, const std::vector<int>& frames);

/// Keeps the scores of every pixel of a split where reports look for them: a row of metrics.jsonl, and for test frames
/// final_eval.json. Scores that are there already stay. `found`: what opening the run had to say. Returns why nothing
/// was kept; "" otherwise.
std::string keep_scores(const OpenedRun& run, const std::string& split, const SplitScore& score,
                        const Diagnostics& found);

}  // namespace semfield
