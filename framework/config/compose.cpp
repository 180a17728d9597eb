#include "config/compose.h"

#include <algorithm>
#include <filesystem>
#include <system_error>
#include <utility>

#include "config/config_words.h"
#include "config/explain.h"
#include "core/files.h"
#include "core/text.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;

// More than anyone writes, few enough that a file including two others over and over ends at once.
constexpr int kMaxIncludedFiles = 256;
constexpr int kMaxIncludeDepth = 32;

/// Loads files with their includes; knows which files are open now (cycles) and how many were read.
class Loader {
 public:
  /// `problems`: where mistakes of includes go instead of being thrown; null: nowhere.
  explicit Loader(Diagnostics* problems = nullptr) : problems_(problems) {}

  ConfigNode load(const std::string& path) {
    open_.push_back(path);
    ConfigNode composed = with_includes(parse_config_file(path));
    open_.pop_back();
    return composed;
  }

  ConfigNode with_includes(const ConfigNode& local) {
    if (!local.is_map()) {
      refuse_at("config.value.type", local.location(),
                "expected a map of sections at the top, got " + kind_text(local));
    }
    ConfigNode composed = ConfigNode::make_map({}, local.location());
    if (const ConfigNode* include = local.find("include")) {
      for (const ConfigNode& item : include->is_list() ? include->items() : std::vector<ConfigNode>{*include}) {
        const std::size_t open = open_.size();
        noting(problems_, [&] { composed = merge_config(composed, load_included(item)); });
        open_.resize(open);
      }
    }
    composed = merge_config(std::move(composed), local.without("include").without("overrides"));
    if (const ConfigNode* over = local.find("overrides"); over != nullptr && !over->is_null())
      noting(problems_, [&] { set_values(composed, overrides_of(*over, "overrides"), problems_); });
    return composed;
  }

 private:
  ConfigNode load_included(const ConfigNode& item) {
    if (!item.is_scalar())
      refuse_at("config.include.file", item.location(), "include: expected a file name, got " + kind_text(item));
    const fs::path written(item.text());
    fs::path path =
        written.is_absolute() ? written : (fs::path(item.location().file).parent_path() / written).lexically_normal();
    if (!is_there(path) || is_folder(path)) {
      const std::string shipped = shipped_config(item.text());
      if (shipped.empty()) {
        const std::string place = shipped_place(item.text());
        std::string near = near_config(item.text(), path.string());
        if (!near.empty() && !near.ends_with(".yaml")) near += ".yaml";  // which an include has to write
        if (near == item.text()) near.clear();                           // a folder of that name
        noting(problems_, [&] {
          refuse_at("config.include.file", item.location(),
                    "include: no file '" + item.text() + "' (looked for '" + path.string() + "'" +
                        (place.empty() ? ")" : " and '" + place + "')"),
                    near.empty() ? "paths in a config are relative to the file that wrote them"
                                 : "did you mean '" + near + "'?");
        });
        // What else is wrong is known by the file that was meant.
        return near.empty() ? ConfigNode::make_map({}, item.location())
                            : load_included(ConfigNode::make_scalar(near, false, item.location()));
      }
      path = shipped;
    }
    const auto first = std::find_if(open_.begin(), open_.end(), [&](const std::string& file) {
      std::error_code unknown;
      return fs::equivalent(file, path, unknown);
    });
    if (first != open_.end()) {
      refuse_at(
          "config.include.cycle", item.location(),
          "include: '" + item.text() + "' includes itself: " + join({first, open_.end()}, " -> ") + " -> " + *first);
    }
    if (open_.size() >= kMaxIncludeDepth || ++included_ > kMaxIncludedFiles) {
      refuse_at("config.include.limit", item.location(),
                "include: more than " + std::to_string(kMaxIncludedFiles) + " files or " +
                    std::to_string(kMaxIncludeDepth) + " levels");
    }
    return load(path.string());
  }

  Diagnostics* problems_;
  std::vector<std::string> open_;  // the file that is read, behind those that include it
  int included_ = 0;
};

}  // namespace

ConfigNode compose_config(const std::string& path, const std::vector<std::string>& overrides, Diagnostics* problems) {
  ConfigNode tree = Loader(problems).load(find_config(path));
  return with_overrides(std::move(tree), parse_overrides(overrides, problems), problems);
}

ConfigNode compose_config_with(const std::string& path, const std::vector<ConfigOverride>& overrides) {
  return with_overrides(Loader().load(find_config(path)), overrides);
}

ConfigNode compose_config_tree(const ConfigNode& tree, const std::vector<ConfigOverride>& overrides) {
  return with_overrides(Loader().with_includes(tree), overrides);
}

std::string resolve_path(const ConfigNode& scalar) {
  const fs::path written(scalar.text());
  if (written.is_absolute()) return written.lexically_normal().string();
  const Location& where = scalar.location();
  // An override is written on the command line: its paths are relative to the working folder, as are those of no file.
  const fs::path folder = where.line == 0 ? fs::path() : fs::path(where.file).parent_path();
  return fs::absolute(folder / written).lexically_normal().string();
}

}  // namespace semfield
