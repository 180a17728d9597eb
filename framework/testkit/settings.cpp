// Visitors that read and write parameters as texts.
#include "testkit/settings.h"

#include <charconv>
#include <cmath>
#include <cstdio>
#include <set>
#include <system_error>

#include "core/text.h"
#include "system/files.h"

namespace semfield::testkit {

namespace {

template <class T>
bool parse_number(const std::string& text, T& value) {
  const char* end = text.data() + text.size();
  const auto [stop, problem] = std::from_chars(text.data(), end, value);
  return problem == std::errc() && stop == end;
}

std::string real_text(double value) {
  char text[40];
  const auto [end, problem] = std::to_chars(text, text + sizeof(text), value);
  return problem == std::errc() ? std::string(text, end) : std::string("nan");
}

std::vector<std::string> split(const std::string& text) {
  std::vector<std::string> parts;
  if (text.empty()) return parts;
  std::size_t begin = 0;
  for (;;) {
    const std::size_t comma = text.find(',', begin);
    parts.push_back(text.substr(begin, comma - begin));
    if (comma == std::string::npos) return parts;
    begin = comma + 1;
  }
}

class SettingsReader final : public ParamVisitor {
 public:
  explicit SettingsReader(const Settings& settings) : settings_(settings) {}

  void boolean(const ParamInfo& info, bool& value) override {
    if (const std::string* text = given(info)) {
      if (*text != "true" && *text != "false") return refuse(info, "expected true or false", *text);
      value = *text == "true";
    }
  }
  void integer(const ParamInfo& info, std::int64_t& value) override {
    if (const std::string* text = given(info)) read_number(info, *text, "int", value);
  }
  void real(const ParamInfo& info, double& value) override {
    if (const std::string* text = given(info)) read_number(info, *text, "real", value);
  }
  void text(const ParamInfo& info, std::string& value) override {
    if (const std::string* text = given(info)) value = *text;
  }
  void choice(const ParamInfo& info, int& value, std::span<const std::string_view> names) override {
    const std::string* text = given(info);
    if (text == nullptr) return;
    for (std::size_t i = 0; i < names.size(); ++i) {
      if (names[i] == *text) {
        value = static_cast<int>(i);
        return;
      }
    }
    refuse(info, "expected one of its choices", *text);
  }
  void integers(const ParamInfo& info, std::vector<std::int64_t>& value) override { read_list(info, "int", value); }
  void reals(const ParamInfo& info, std::vector<double>& value) override { read_list(info, "real", value); }
  void texts(const ParamInfo& info, std::vector<std::string>& value) override {
    if (const std::string* text = given(info)) value = split(*text);
  }

  Failures finish() {
    for (const auto& [name, value] : settings_) {
      if (!seen_.contains(name)) failures_.push_back("unknown parameter '" + name + "'");
    }
    return failures_;
  }

 private:
  const std::string* given(const ParamInfo& info) {
    seen_.insert(std::string(info.name));
    const auto found = settings_.find(std::string(info.name));
    return found == settings_.end() ? nullptr : &found->second;
  }
  void refuse(const ParamInfo& info, const std::string& expected, const std::string& text) {
    failures_.push_back(std::string(info.name) + ": " + expected + ", got '" + text + "'");
  }
  template <class T>
  bool read_number(const ParamInfo& info, const std::string& text, const char* type, T& value) {
    T parsed{};
    const bool ok = parse_number(text, parsed);
    const auto as_real = static_cast<double>(parsed);
    if (!ok || !std::isfinite(as_real) || as_real < info.range.min || as_real > info.range.max) {
      refuse(info,
             std::string("expected ") + type + " in [" + real_text(info.range.min) + ", " + real_text(info.range.max) +
                 "]",
             text);
      return false;
    }
    value = parsed;
    return true;
  }
  template <class T>
  void read_list(const ParamInfo& info, const char* type, std::vector<T>& value) {
    const std::string* text = given(info);
    if (text == nullptr) return;
    std::vector<T> parsed;
    for (const std::string& part : split(*text)) {
      T element{};
      if (!read_number(info, part, type, element)) return;
      parsed.push_back(element);
    }
    value = std::move(parsed);
  }

  const Settings& settings_;
  std::set<std::string> seen_;
  Failures failures_;
};

class SettingsWriter final : public ParamVisitor {
 public:
  Settings settings;
  void boolean(const ParamInfo& info, bool& value) override { put(info, value ? "true" : "false"); }
  void integer(const ParamInfo& info, std::int64_t& value) override { put(info, std::to_string(value)); }
  void real(const ParamInfo& info, double& value) override { put(info, real_text(value)); }
  void text(const ParamInfo& info, std::string& value) override { put(info, value); }
  void choice(const ParamInfo& info, int& value, std::span<const std::string_view> names) override {
    put(info, std::string(names[static_cast<std::size_t>(value)]));
  }
  void integers(const ParamInfo& info, std::vector<std::int64_t>& value) override {
    std::vector<std::string> parts;
    for (const std::int64_t element : value) parts.push_back(std::to_string(element));
    put(info, join(parts, ","));
  }
  void reals(const ParamInfo& info, std::vector<double>& value) override {
    std::vector<std::string> parts;
    for (const double element : value) parts.push_back(real_text(element));
    put(info, join(parts, ","));
  }
  void texts(const ParamInfo& info, std::vector<std::string>& value) override { put(info, join(value, ",")); }

 private:
  void put(const ParamInfo& info, std::string text) { settings[std::string(info.name)] = std::move(text); }
};

}  // namespace

std::vector<SettingsLine> read_settings_lines(const std::string& path) {
  std::vector<SettingsLine> lines;
  const std::string text = read_text_file(path);
  std::string_view rest = text, line;
  for (int number = 1; next_line(rest, line); ++number) {
    const std::vector<std::string_view> words = words_of(line);
    if (words.empty() || words[0].starts_with('#')) continue;
    SettingsLine read{number, {}};
    for (const std::string_view word : words) {
      if (words.size() == 1 && word == "defaults") break;
      const std::size_t equals = word.find('=');
      if (equals == std::string_view::npos || equals == 0)
        throw Error(ErrorKind::config, "plugin.laws.settings",
                    path + ":" + std::to_string(number) + ": '" + std::string(word) + "' sets nothing",
                    "write name=value name=value, or the one word defaults");
      read.settings[std::string(word.substr(0, equals))] = word.substr(equals + 1);
    }
    lines.push_back(std::move(read));
  }
  return lines;
}

Failures apply_settings(PluginParams& params, const Settings& settings) {
  SettingsReader reader(settings);
  params.describe(reader);
  return reader.finish();
}

Settings settings_of(PluginParams& params) {
  SettingsWriter writer;
  params.describe(writer);
  return writer.settings;
}

std::unique_ptr<PluginParams> make_params(const PluginEntry& entry, const Settings& settings) {
  std::unique_ptr<PluginParams> params = entry.new_params();
  Diagnostics diagnostics;
  for (const std::string& failure : apply_settings(*params, settings))
    diagnostics.error("plugin.laws.settings", entry.name, failure, {});
  params->validate(diagnostics);
  diagnostics.throw_if_errors(ErrorKind::config, {});
  return params;
}

}  // namespace semfield::testkit
