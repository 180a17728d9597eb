// metrics.jsonl: writer, reader, resume.
#include "train/metrics_log.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <nlohmann/json.hpp>

#include "core/error.h"
#include "eval/metrics.h"

namespace semfield {

namespace {

using Json = nlohmann::ordered_json;

MetricsRow parse_row(std::string_view line, const std::string& place) {
  const auto fail = [&](const std::string& what) -> Error {
    return Error(ErrorKind::data, "run.metrics.damaged", place + ": " + what,
                 "delete the line, or the rows from there on");
  };
  const Json json = Json::parse(line.begin(), line.end(), nullptr, false);
  if (!json.is_object()) throw fail("not a JSON object");
  MetricsRow row;
  bool has_step = false;
  for (const auto& [key, value] : json.items()) {
    if (key == "kind" || key == "split") {
      if (!value.is_string()) throw fail("'" + key + "' is not a text");
      (key == "kind" ? row.kind : row.split) = value.get<std::string>();
    } else if (key == "step") {
      if (!value.is_number_integer()) throw fail("'step' is not an integer");
      if (value.get<std::int64_t>() < 0) throw fail("'step' is below 0, or too large");
      row.step = value.get<std::int64_t>();
      has_step = true;
    } else if (key == "per_class_iou") {
      if (!value.is_object()) throw fail("'per_class_iou' is not a map");
      for (const auto& [name, iou] : value.items()) {
        std::optional<double> read;
        if (!read_number_json(iou, read)) throw fail("'per_class_iou' of '" + name + "' is not a number");
        row.per_class_iou.emplace_back(name, read);
      }
    } else {
      std::optional<double> read;
      if (!read_number_json(value, read)) throw fail("'" + key + "' is not a number");
      if (key == "train_s") {
        row.train_s = read.value_or(0);
      } else {
        row.values.emplace_back(key, read);
      }
    }
  }
  if (!has_step) throw fail("no 'step'");
  return row;
}

// Calls body(line, number) for every line that ends in a newline; returns the bytes they take.
template <class Body>
std::size_t each_line(std::string_view text, Body&& body) {
  std::size_t begin = 0;
  for (int number_of_line = 1;; ++number_of_line) {
    const std::size_t end = text.find('\n', begin);
    if (end == std::string_view::npos) return begin;
    body(text.substr(begin, end - begin), number_of_line);
    begin = end + 1;
  }
}

FileDescriptor open_log(const std::string& path) {
  FileDescriptor file = open_for_appending(path);
  if (file < 0)
    throw Error(ErrorKind::cannot_create, "files.write.failed",
                fmt::format("cannot open '{}' for writing: {}", path, std::strerror(errno)),
                "make the run folder writable, or choose another with --out");
  return file;
}

}  // namespace

void MetricsRow::set(const std::string& name, std::optional<double> value) {
  for (auto& [key, present] : values) {
    if (key != name) continue;
    present = value;
    return;
  }
  values.emplace_back(name, value);
}

std::optional<double> MetricsRow::get(std::string_view name) const {
  for (const auto& [key, value] : values) {
    if (key == name) return value;
  }
  return std::nullopt;
}

std::string metrics_line(const MetricsRow& row) {
  Json json;
  json["kind"] = row.kind;
  json["step"] = row.step;
  json["train_s"] = number_json<Json>(row.train_s);
  if (!row.split.empty()) json["split"] = row.split;
  for (const auto& [name, value] : row.values) json[name] = number_json<Json>(value);
  if (!row.per_class_iou.empty()) {
    Json& map = json["per_class_iou"] = Json::object();
    for (const auto& [name, value] : row.per_class_iou) map[name] = number_json<Json>(value);
  }
  return json.dump(-1, ' ', false, Json::error_handler_t::replace);
}

std::vector<MetricsRow> parse_metrics(std::string_view text, const std::string& name) {
  std::vector<MetricsRow> rows;
  each_line(text, [&](std::string_view line, int number_of_line) {
    rows.push_back(parse_row(line, fmt::format("{}:{}", name, number_of_line)));
  });
  return rows;
}

std::vector<MetricsRow> read_metrics(const std::string& path) { return parse_metrics(read_text_file(path), path); }

MetricsLog::MetricsLog(std::string path) : path_(std::move(path)), file_(open_log(path_)) {}

MetricsLog MetricsLog::resume(const std::string& path, std::int64_t step) {
  if (fs::exists(path)) {
    const std::string text = read_text_file(path);
    std::string kept;
    std::optional<Error> unreadable;
    each_line(text, [&](std::string_view line, int number_of_line) {
      try {
        if (parse_row(line, fmt::format("{}:{}", path, number_of_line)).step > step) return;
      } catch (const Error& error) {
        if (!unreadable) unreadable = error;
        return;
      }
      // Rows up to the checkpoint were synced before it, so a bad line ahead of one is no trace of a power cut.
      if (unreadable) throw *unreadable;
      kept += line;
      kept += '\n';
    });
    if (kept.size() != text.size()) write_file_atomic(path, kept);
  }
  return MetricsLog(path);
}

void MetricsLog::append(const MetricsRow& row) {
  if (torn_from_ >= 0 && ::ftruncate(file_, torn_from_) != 0) throw write_error("shorten", path_, errno);
  torn_from_ = -1;
  const off_t before = ::lseek(file_, 0, SEEK_END);
  try {
    append_all(file_, path_, metrics_line(row) + "\n");
  } catch (const Error&) {
    // A part of a row would spoil the next one.
    if (before >= 0 && ::ftruncate(file_, before) != 0) torn_from_ = before;
    throw;
  }
}

void MetricsLog::sync() { sync_file(file_, path_); }

}  // namespace semfield
