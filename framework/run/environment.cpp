// environment.json and left_out.json.
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <fstream>
#include <nlohmann/json.hpp>

#include "compute/parallel.h"
#include "core/error.h"
#include "plugin/module.h"
#include "run/run_folder.h"

#ifndef SEMFIELD_VERSION_TEXT
#define SEMFIELD_VERSION_TEXT "unknown"
#endif
#ifndef SEMFIELD_SOURCE_AT_CONFIGURE
#define SEMFIELD_SOURCE_AT_CONFIGURE ""
#endif
#ifndef SEMFIELD_BUILD_TYPE
#define SEMFIELD_BUILD_TYPE ""
#endif

namespace semfield {

namespace {

using Json = nlohmann::ordered_json;

// "key : value" of the first core in /proc/cpuinfo; "" where the system has no such file.
std::string cpu_info(const std::string& key) {
  std::ifstream file("/proc/cpuinfo");
  for (std::string line; std::getline(file, line);) {
    if (!line.starts_with(key)) continue;
    const std::size_t colon = line.find(": ");
    if (colon != std::string::npos) return line.substr(colon + 2);
  }
  return {};
}

// Of some hundred flags, those that change which instructions our loops become.
std::string cpu_features() {
  const std::string flags = " " + cpu_info("flags") + " ";
  constexpr std::array kTelling{"sse4_2",  "avx",      "avx2",     "fma",         "f16c",
                                "avx512f", "avx512bw", "avx512vl", "avx512_bf16", "amx_bf16"};
  std::vector<std::string> found;
  for (const char* flag : kTelling) {
    if (flags.find(fmt::format(" {} ", flag)) != std::string::npos) found.emplace_back(flag);
  }
  return join(found, " ");
}

std::string compiler() {
#if defined(__clang__)
  return "clang " __clang_version__;
#elif defined(__GNUC__)
  return "g++ " __VERSION__;
#else
  return "unknown";
#endif
}

Json parse(std::string_view text, const std::string& name) {
  Json json = Json::parse(text.begin(), text.end(), nullptr, false);
  if (json.is_discarded())
    throw Error(ErrorKind::data, "run.record.damaged", fmt::format("'{}' is not JSON", name),
                "restore the file, or delete it");
  return json;
}

}  // namespace

Environment this_environment() {
  Environment e;
  e.version = SEMFIELD_VERSION_TEXT;
  e.source = SEMFIELD_SOURCE_AT_CONFIGURE;
  e.compiler = compiler();
  e.build_type = SEMFIELD_BUILD_TYPE;
  e.cpu = cpu_info("model name");
  e.cpu_features = cpu_features();
  e.abi = SEMFIELD_ABI_TAG;
  e.hardware_threads = hardware_threads();
  e.threads = thread_count();
  return e;
}

std::string environment_json(const Environment& e) {
  Json json;
  json["version"] = e.version;
  json["source_at_configure"] = e.source;
  json["compiler"] = e.compiler;
  json["build_type"] = e.build_type;
  json["cpu"] = e.cpu;
  json["cpu_features"] = e.cpu_features;
  json["abi"] = e.abi;
  json["hardware_threads"] = e.hardware_threads;
  json["threads"] = e.threads;
  json["seed"] = e.seed;
  json["input_hash"] = e.input_hash;
  json["modules"] = e.modules;
  if (!e.settings_changed.empty()) json["settings_changed"] = e.settings_changed;
  for (const auto& [name, value] : e.more) json[name] = value;
  return json.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
}

std::vector<std::pair<std::string, std::string>> parse_environment(std::string_view text, const std::string& name) {
  const Json json = parse(text, name);
  if (!json.is_object())
    throw Error(ErrorKind::data, "run.record.damaged", fmt::format("'{}' is not a JSON object", name),
                "restore the file, or delete it");
  std::vector<std::pair<std::string, std::string>> entries;
  for (const auto& [key, value] : json.items()) {
    std::string shown = value.is_string() ? value.get<std::string>() : value.dump();
    if (value.is_array()) {
      std::vector<std::string> items;
      for (const Json& item : value) items.push_back(item.is_string() ? item.get<std::string>() : item.dump());
      shown = join(items);
    }
    entries.emplace_back(key, std::move(shown));
  }
  return entries;
}

std::vector<std::string> parse_settings_changed(std::string_view text, const std::string& name) {
  const Json json = parse(text, name);
  std::vector<std::string> changes;
  if (!json.is_object() || !json.contains("settings_changed")) return changes;
  for (const Json& change : json["settings_changed"]) {
    changes.push_back(change.is_string() ? change.get<std::string>() : change.dump());
  }
  return changes;
}

namespace {

constexpr std::array<std::pair<const char*, std::string LeftOutRow::*>, 6> kLeftOutFields{{
    {"component", &LeftOutRow::component},
    {"rule", &LeftOutRow::rule},
    {"evidence", &LeftOutRow::evidence},
    {"proof", &LeftOutRow::proof},
    {"saving_estimate", &LeftOutRow::saving_estimate},
    {"saving_measured", &LeftOutRow::saving_measured},
}};

}  // namespace

std::string left_out_json(const std::vector<LeftOutRow>& rows) {
  Json json = Json::array();
  for (const LeftOutRow& row : rows) {
    Json& object = json.emplace_back(Json::object());
    for (const auto& [name, field] : kLeftOutFields) object[name] = row.*field;
    if (row.saving_measured.empty()) object["saving_measured"] = nullptr;  // not measured is not text
  }
  return json.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
}

std::vector<LeftOutRow> parse_left_out(std::string_view text, const std::string& name) {
  const Json json = parse(text, name);
  if (!json.is_array())
    throw Error(ErrorKind::data, "run.record.damaged", fmt::format("'{}' is not a list", name),
                "restore the file, or delete it");
  std::vector<LeftOutRow> rows;
  for (const Json& object : json) {
    LeftOutRow row;
    for (const auto& [key, field] : kLeftOutFields) {
      if (!object.is_object() || !object.contains(key)) continue;
      const Json& value = object[key];
      row.*field = value.is_string() ? value.get<std::string>() : value.is_null() ? "" : value.dump();
    }
    if (row.component.empty()) {
      throw Error(ErrorKind::data, "run.record.damaged",
                  fmt::format("'{}': row {} names no component", name, rows.size() + 1),
                  "restore the file, or delete it");
    }
    rows.push_back(std::move(row));
  }
  return rows;
}

}  // namespace semfield
