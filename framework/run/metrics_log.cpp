// metrics.jsonl: writer, reader, resume.
#include "run/metrics_log.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <bit>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <nlohmann/json.hpp>
#include <span>

#include "core/error.h"
#include "eval/metrics.h"
#include "session/settings/choices.h"
#include "system/checksum.h"

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

void put_varint(std::string& out, std::uint64_t value) {
  while (value >= 0x80) {
    out.push_back(static_cast<char>(value | 0x80));
    value >>= 7;
  }
  out.push_back(static_cast<char>(value));
}

template <class T>
void put_fixed(std::string& out, T value) {
  char bytes[sizeof(T)];
  std::memcpy(bytes, &value, sizeof(T));
  out.append(bytes, sizeof(T));
}

FileDescriptor open_log(const std::string& path) {
  FileDescriptor file = open_for_appending(path);
  if (file < 0)
    throw Error(ErrorKind::cannot_create, "files.write.failed",
                fmt::format("cannot open '{}' for writing: {}", path, std::strerror(errno)),
                "make the run folder writable, or choose another with --out");
  return file;
}

enum Wire : std::uint64_t { varint = 0, fixed64 = 1, sized = 2, fixed32 = 5 };

void put_key(std::string& out, std::uint64_t field, Wire wire) { put_varint(out, field << 3 | wire); }

void put_text(std::string& out, std::uint64_t field, std::string_view text) {
  put_key(out, field, Wire::sized);
  put_varint(out, text.size());
  out += text;
}

// Event { double wall_time = 1; int64 step = 2; string file_version = 3; Summary summary = 5; }
std::string event_head(double now_s) {
  std::string event;
  put_key(event, 1, Wire::fixed64);
  put_fixed(event, now_s);
  return event;
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
  if (std::filesystem::exists(path)) {
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

// Event records: protocol buffer messages Event and Summary with the few fields that a scalar needs.

std::uint32_t masked_crc32c(std::string_view bytes) {
  const std::uint32_t crc = crc32c(std::as_bytes(std::span(bytes.data(), bytes.size())));
  return std::rotr(crc, 15) + 0xA282EAD8u;
}

std::string record_frame(std::string_view bytes) {
  std::string frame;
  put_fixed(frame, static_cast<std::uint64_t>(bytes.size()));
  put_fixed(frame, masked_crc32c(frame));
  frame += bytes;
  put_fixed(frame, masked_crc32c(bytes));
  return frame;
}

EventWriter::EventWriter(const std::string& folder, double now_s) {
  char host[256] = "host";
  if (::gethostname(host, sizeof(host) - 1) != 0) std::strcpy(host, "host");
  path_ =
      fmt::format("{}/events.out.tfevents.{:010d}.{}.{}", folder, static_cast<std::int64_t>(now_s), host, ::getpid());
  file_ = open_log(path_);
  std::string event = event_head(now_s);
  put_text(event, 3, "brain.Event:2");
  write(event);
}

void EventWriter::scalar(std::string_view tag, std::int64_t step, double value, double now_s) {
  std::string point;  // Summary.Value { string tag = 1; float simple_value = 2; }
  put_text(point, 1, tag);
  put_key(point, 2, Wire::fixed32);
  put_fixed(point, static_cast<float>(value));
  std::string summary;  // Summary { repeated Value value = 1; }
  put_text(summary, 1, point);
  std::string event = event_head(now_s);
  put_key(event, 2, Wire::varint);
  put_varint(event, static_cast<std::uint64_t>(step));
  put_text(event, 5, summary);
  write(event);
}

void EventWriter::write(const std::string& event) { append_all(file_, path_, record_frame(event)); }

}  // namespace semfield
