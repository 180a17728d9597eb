// The laws of every kind on plugins that a registry has: what `semfield plugins check` and tests of plugins run.
#include <algorithm>

#include "plugin/loader.h"
#include "testkit/laws.h"

namespace semfield::testkit {

namespace {

/// Plugins that take long (PluginEntry::slow) are asked less often, not less strictly.
LawOptions options_of(const PluginEntry& entry, const LawRequest& request) {
  LawOptions options;
  options.on_law = request.on_law;
  // Elements of each tensor that central differences check: the more, the cheaper a call is.
  options.gradient_elements = entry.slow                                                            ? 4
                              : entry.kind == PluginKind::field                                     ? 6
                              : entry.kind == PluginKind::encoder || entry.kind == PluginKind::head ? 12
                                                                                                    : 24;
  if (entry.slow) options.many_rows = 257;
  return options;
}

std::string text_of(const Settings& settings) {
  std::string text;
  for (const auto& [name, value] : settings) text += (text.empty() ? "" : " ") + name + "=" + value;
  return text.empty() ? "defaults" : text;
}

std::vector<std::string> parameters_of(const PluginEntry& entry) {
  std::vector<std::string> names;
  const std::unique_ptr<PluginParams> params = entry.new_params();
  for (const ParamDoc& doc : describe_params(described(*params))) names.push_back(doc.name);
  return names;
}

bool has_all(const PluginEntry& entry, const Settings& settings) {
  const std::vector<std::string> names = parameters_of(entry);
  return std::all_of(settings.begin(), settings.end(), [&](const auto& setting) {
    return std::find(names.begin(), names.end(), setting.first) != names.end();
  });
}

class Suite {
 public:
  Suite(const Registry& registry, const LawRequest& request, std::vector<SettingsLine> lines)
      : registry_(registry), request_(request), lines_(std::move(lines)) {
    require_fit();
    read_scene();
  }

  void run() const {
    for (const PluginEntry* entry : request_.entries) {
      tell({entry->kind, entry->name, "", "", LawStatus::passed, {}}, [&] { return declaration_laws(*entry); });
      for (const Settings& settings : rows_of(*entry)) {
        const auto alone = [&](const auto& laws) {
          tell({entry->kind, entry->name, text_of(settings), "", LawStatus::passed, {}}, laws);
        };
        with_builds(registry_, entry->kind, entry->name, Device::cpu,
                    [&](const auto& builds) { check(*entry, settings, builds); });
        if (entry->kind == PluginKind::dataset)
          alone([&] { return dataset_laws(registry_, entry->name, settings, DatasetBuild{request_.folder}); });
        if (entry->kind == PluginKind::loss)
          alone([&] { return loss_laws(*entry->loss(*make_params(*entry, settings)), options_of(*entry, request_)); });
        if (entry->kind == PluginKind::grouping)
          alone([&] {
            return grouping_laws(*entry->grouping(*make_params(*entry, settings)), options_of(*entry, request_));
          });
      }
    }
  }

 private:
  // A line is for the plugins that have every parameter it names. What is wrong with a line is no fault of theirs.
  void require_fit() const {
    for (const SettingsLine& line : lines_) {
      const std::string place = request_.settings_file + ":" + std::to_string(line.number) + ": ";
      bool fits = false;
      for (const PluginEntry* entry : request_.entries) {
        if (!has_all(*entry, line.settings)) continue;
        fits = true;
        try {
          if (entry->kind != PluginKind::dataset) (void)make_params(*entry, line.settings);
        } catch (const Error& error) {
          throw Error(ErrorKind::config, error.code(), place + error.message(), error.remedy());
        }
      }
      if (fits) continue;
      std::vector<std::string> known;
      for (const PluginEntry* entry : request_.entries) {
        for (const std::string& name : parameters_of(*entry)) known.push_back(name);
      }
      throw Error(ErrorKind::config, "plugin.laws.settings",
                  place + "no plugin has the parameters of '" + text_of(line.settings) + "'", "known: " + join(known));
    }
  }

  void read_scene() {
    for (const std::string& word : request_.scene) {
      const std::size_t equals = word.find('=');
      if (equals == std::string::npos || equals == 0)
        throw Error(ErrorKind::usage, "usage.value.scene", "--scene " + word + ": expected NAME=VALUE",
                    "such as --scene root=my_room");
      scene_[word.substr(0, equals)] = word.substr(equals + 1);
    }
    bool dataset = false;
    for (const PluginEntry* entry : request_.entries) {
      if (entry->kind != PluginKind::dataset) continue;
      dataset = true;
      try {
        for (const Settings& settings : rows_of(*entry)) require_opens(*entry, settings);
      } catch (const Error& error) {
        throw Error(ErrorKind::usage, "plugin.laws.scene",
                    "dataset '" + entry->name + "' needs a scene that its laws can read: " + error.message(),
                    "add --scene NAME=VALUE for each of its parameters that names one: " + join(parameters_of(*entry)));
      }
    }
    if (!dataset && !scene_.empty())
      throw Error(ErrorKind::usage, "usage.flag.conflict", "--scene is for datasets, and the file registers none",
                  "leave --scene out");
  }

  // A scene that is not there is no broken law.
  void require_opens(const PluginEntry& entry, const Settings& settings) const {
    Diagnostics diagnostics;
    (void)entry.dataset(*make_params(entry, settings), DatasetBuild{request_.folder})->open(diagnostics);
    diagnostics.throw_if_errors(ErrorKind::data, {});
  }

  std::vector<Settings> rows_of(const PluginEntry& entry) const {
    std::vector<Settings> rows;
    for (const SettingsLine& line : lines_) {
      if (has_all(entry, line.settings)) rows.push_back(line.settings);
    }
    if (rows.empty()) rows.emplace_back();
    if (entry.kind == PluginKind::dataset) {
      for (Settings& row : rows) row.insert(scene_.begin(), scene_.end());
    }
    return rows;
  }

  void begin(const LawRow& row) const {
    if (request_.on_begin) request_.on_begin(row);
  }

  template <class Laws>
  void tell(LawRow row, const Laws& laws) const {
    begin(row);
    try {
      row.found = laws();
    } catch (const std::exception& error) {
      row.found = {std::string("an error came out of a law: ") + error.what()};
    }
    row.status = row.found.empty() ? LawStatus::passed : LawStatus::failed;
    request_.on_row(row);
  }

  template <class Build>
  void check(const PluginEntry& entry, const Settings& settings, const std::vector<Build>& builds) const {
    std::size_t accepted = 0;
    for (const Build& build : builds) {
      LawRow row{entry.kind, entry.name, text_of(settings), testkit::text_of(build), LawStatus::passed, {}};
      begin(row);
      decltype(make_twins(registry_, entry.name, settings, build)) twins;
      try {
        twins = make_twins(registry_, entry.name, settings, build);
      } catch (const Error& error) {
        // One that every way of building refuses has nothing that a law could be asked of.
        const bool last = accepted == 0 && &build == &builds.back();
        row.status = last ? LawStatus::failed : LawStatus::refused;
        row.found = {(last ? "every way of building was refused: " : "") + std::string(error.what())};
        request_.on_row(row);
        continue;
      }
      ++accepted;
      tell(std::move(row), [&] { return laws_of(*twins.single, *twins.oracle, build, options_of(entry, request_)); });
    }
  }
  const Registry& registry_;
  const LawRequest& request_;
  std::vector<SettingsLine> lines_;
  Settings scene_;
};

}  // namespace

Failures plugin_laws(const Registry& registry, PluginKind kind, const std::string& name, const Settings& settings) {
  Failures failures;
  LawRequest request;
  request.entries = {&registry.get(kind, name)};
  request.settings_file = "settings";
  request.on_row = [&](const LawRow& row) {
    if (row.status != LawStatus::failed) return;
    for (const std::string& sentence : row.found)
      failures.push_back(row.build.empty() ? sentence : row.build + ", " + sentence);
  };
  Suite(registry, request, {{1, settings}}).run();
  return failures;
}

}  // namespace semfield::testkit

extern "C" void semfield_law_suite(const semfield::Registry& registry, const semfield::LawRequest& request);
void semfield_law_suite(const semfield::Registry& registry, const semfield::LawRequest& request) {
  using namespace semfield::testkit;
  Suite(registry, request,
        request.settings_file.empty() ? std::vector<SettingsLine>{} : read_settings_lines(request.settings_file))
      .run();
}
