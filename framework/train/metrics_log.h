// metrics.jsonl, the source of truth of a run: one JSON object per line, appended and flushed.
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/files.h"
#include "train/session.h"

namespace semfield {

/// Split of an evaluation row that scored a sample of the split's frames: "test" -> "test_sample".
inline const std::string kSampleSuffix = "_sample";

/// One line. Infinities and NaN are written as the texts "inf", "-inf" and "nan"; a value without data as null, and
/// read back as absent.
struct MetricsRow {
  std::string kind = "train";  ///< "train" or "eval"
  std::int64_t step = 0;
  double train_s = 0;                                                 ///< seconds of training, evaluation not counted
  std::string split;                                                  ///< of an eval row; empty: not written
  std::vector<std::pair<std::string, std::optional<double>>> values;  ///< in the order written
  std::vector<std::pair<std::string, std::optional<double>>> per_class_iou;

  /// Adds a value, or replaces the one of that name.
  void set(const std::string& name, std::optional<double> value);
  std::optional<double> get(std::string_view name) const;
};

/// The line of a row, without the newline.
std::string metrics_line(const MetricsRow& row);

/// Every row of a file. A last line without newline (a write cut off by a kill) is dropped; any other bad line throws
/// Error(data) naming file and line.
std::vector<MetricsRow> read_metrics(const std::string& path);
std::vector<MetricsRow> parse_metrics(std::string_view text, const std::string& name);

/// Appends rows; each is with the system when append returns, so a killed process loses none.
class MetricsLog {
 public:
  /// Drops every row after `step` and what a power cut left of lines behind the last row kept, then opens for
  /// appending a file that may be absent. Throws Error(data) for an unreadable line ahead of a row that is kept.
  static MetricsLog resume(const std::string& path, std::int64_t step);

  /// Throws write_error; nothing of the row stays then, and a later call may succeed.
  void append(const MetricsRow& row);
  /// Makes the rows so far outlive a power cut; a checkpoint is written only after its rows.
  void sync();

 private:
  explicit MetricsLog(std::string path);
  std::string path_;
  FileDescriptor file_;
  std::int64_t torn_from_ = -1;  // where the part of a row begins that could not be taken back
};

}  // namespace semfield
