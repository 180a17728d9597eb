#include "report/report_comparison.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "core/error.h"
#include "report/report_sections.h"
#include "run/run_scores.h"

namespace semfield {

namespace {

struct Group {
  std::string value;
  std::vector<std::string> runs;
};

// Runs by a value; those without one are in no group.
template <class ValueOf>
std::vector<Group> grouped(const ReportInput& input, const ValueOf& value_of) {
  std::vector<Group> groups;
  for (const ReportRun& run : input.runs) {
    const std::string value = value_of(run);
    if (value.empty()) continue;
    const auto known = std::find_if(groups.begin(), groups.end(), [&](const Group& g) { return g.value == value; });
    if (known != groups.end()) {
      known->runs.push_back(run.name);
    } else {
      groups.push_back({value, {run.name}});
    }
  }
  return groups;
}

// "a, b; c".
template <class TextOf>
std::string listed(const std::vector<Group>& groups, const TextOf& text_of) {
  std::vector<std::string> parts;
  for (const Group& group : groups) parts.push_back(join(group.runs, ", ") + text_of(group));
  return join(parts, "; ");
}

std::string names_of_frames(const ReportRun& run) {
  std::string names;
  if (!run.eval) return names;
  for (const FrameScore& frame : run.eval->frames) names += frame.name + '\n';
  return names;
}

bool at_level(const MetricsRow& row, std::string_view key, int better, double level) {
  const auto value = row.get(key);
  return value && better * (*value - level) >= 0;
}

}  // namespace

std::string sample_text(const MetricsRow& row) {
  if (!row.split.ends_with(kSampleSuffix)) return {};
  const auto frames = row.get("frames"), of = row.get("split_frames");
  if (!frames) return "some frames";
  if (!of) return fmt::format("{:.0f} frames", *frames);  // of versions that did not write it
  return ScoredPart{std::llround(*frames), std::llround(*of),
                    static_cast<std::int32_t>(std::lround(row.get("pixel_stride").value_or(1)))}
      .text();
}

std::string part_text(const MetricsRow& row) {
  const std::string sample = sample_text(row);
  if (!sample.empty()) return "a sample, " + sample;
  const auto frames = row.get("frames");
  return frames ? fmt::format("all {:.0f} frames", *frames) : std::string();
}

std::string sample_text(const ReportRun& run, const std::string& split) {
  const std::vector<const MetricsRow*> rows = eval_rows(run, split);
  return rows.empty() ? std::string() : sample_text(*rows.back());
}

std::vector<std::string> unranked_because(const ReportInput& input, const std::string& split) {
  std::vector<std::string> reasons;
  const std::vector<Group> data = grouped(input, [](const ReportRun& run) {
    const auto hash = std::find_if(run.environment.begin(), run.environment.end(),
                                   [](const auto& entry) { return entry.first == "input_hash"; });
    return hash == run.environment.end() ? std::string() : hash->second;
  });
  if (data.size() > 1) {
    reasons.push_back("they read different data (another scene, or other frames or sizes of one): " +
                      listed(data, [&](const Group& group) {
                        const auto run = std::find_if(input.runs.begin(), input.runs.end(),
                                                      [&](const ReportRun& r) { return r.name == group.runs.front(); });
                        return run->scene.empty() ? "" : " on " + run->scene;
                      }));
  }
  const std::vector<Group> parts = grouped(input, [&](const ReportRun& run) {
    const std::vector<const MetricsRow*> rows = eval_rows(run, split);
    if (rows.empty()) return std::string();
    // Other data have another number of frames; that is no reason of its own.
    return data.size() > 1 && sample_text(*rows.back()).empty() ? "all frames" : part_text(*rows.back());
  });
  if (parts.size() > 1) {
    reasons.push_back("their last evaluations scored other parts of the split: " +
                      listed(parts, [](const Group& group) { return " " + group.value; }));
  } else if (data.size() < 2 && grouped(input, names_of_frames).size() > 1) {
    reasons.push_back("they were scored on other frames: " +
                      listed(grouped(input, names_of_frames), [](const Group& group) {
                        return " on " + group.value.substr(0, group.value.find('\n')) + " and others";
                      }));
  } else if (data.size() < 2) {
    const std::vector<Group> pixels = grouped(input, [&](const ReportRun& run) {
      const std::vector<const MetricsRow*> rows = eval_rows(run, split);
      const auto count = rows.empty() ? std::nullopt : rows.back()->get("pixels");
      return count ? fmt::format("{:.0f}", *count) : std::string();
    });
    if (pixels.size() > 1)
      reasons.push_back("they were scored on other pixels: " +
                        listed(pixels, [](const Group& group) { return " on " + group.value; }));
  }
  return reasons;
}

int best_of(const ReportInput& input, const std::string& split, const std::vector<std::optional<double>>& values,
            int better) {
  return unranked_because(input, split).empty() ? best_run(values, better) : -1;
}

std::vector<const MetricsRow*> curve_rows(const ReportRun& run, const std::string& split) {
  std::vector<const MetricsRow*> rows;
  for (const MetricsRow& row : run.rows) {
    if (row.kind != "eval" || row.split != split + kSampleSuffix) continue;
    if (rows.empty() || sample_text(row) == sample_text(*rows.front())) rows.push_back(&row);
  }
  return rows.size() < 2 ? eval_rows(run, split) : rows;
}

std::vector<std::vector<const MetricsRow*>> level_rows(const ReportInput& input, const std::string& split) {
  std::vector<std::vector<const MetricsRow*>> rows, whole;
  bool same = true;
  for (const ReportRun& run : input.runs) {
    rows.push_back(curve_rows(run, split));
    whole.push_back(eval_rows(run, split));
    same = same && !rows.back().empty() && !rows.front().empty() &&
           part_text(*rows.back().front()) == part_text(*rows.front().front());
  }
  return same ? rows : whole;
}

std::optional<LevelTime> time_of_level(const std::vector<const MetricsRow*>& rows, std::string_view key, int better,
                                       double level) {
  LevelTime time;
  bool before = false;
  for (const MetricsRow* row : rows) {
    if (!row->get(key)) continue;
    time.not_after_s = row->train_s;
    if (at_level(*row, key, better, level)) {
      time.at_first = !before;
      time.only = rows.size() == 1;
      return time;
    }
    time.not_before_s = row->train_s;
    before = true;
  }
  return std::nullopt;
}

int first_for_certain(const std::vector<std::optional<LevelTime>>& times) {
  for (std::size_t i = 0; i < times.size(); ++i) {
    if (!times[i]) continue;
    bool first = times.size() > 1;
    for (std::size_t j = 0; j < times.size(); ++j)
      first = first && (i == j || (times[j] && times[i]->not_after_s <= times[j]->not_before_s));
    if (first) return static_cast<int>(i);
  }
  return -1;
}

}  // namespace semfield
