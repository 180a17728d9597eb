// classes: class tables from and to the forms of other tools.
#include <algorithm>
#include <cstdio>
#include <filesystem>

#include "app/json_output.h"
#include "app/verb.h"
#include "scene/classes/class_table.h"
#include "system/files.h"

namespace semfield::app {

namespace {

struct ClassesOptions : Options {
  using Options::Options;
  const std::string& in =
      operand("table", "table (.yaml, .csv, .json, CVAT's .txt, ScanNet's .tsv), or nyu13, nyu40, scannet20");
  const std::string& format =
      choice("--format FORMAT", "yaml", {"yaml", "csv", "cvat"}, "form of the table that is written");
  const std::string& ids =
      choice("--ids IDS", "raw", {"raw", "nyu40", "nyu13"}, "ids to take from ScanNet's .tsv: raw, nyu40 or nyu13");
  const std::string& colors = choice("--colors COLORS", "keep", {"keep", "pascal", "semfield"},
                                     "keep them, or pascal (VOC's bit pattern) or semfield");
  const std::string& out = value("--out FILE", "file to write (default: stdout)");
};

ClassTable table_of(const ClassesOptions& options) {
  const bool is_tsv = std::filesystem::path(options.in).extension() == ".tsv";
  if (options.ids != "raw" && !is_tsv) {
    throw Error(ErrorKind::usage, "usage.flag.conflict",
                "--ids " + options.ids + ": '" + options.in + "' is not a table of ScanNet",
                "give scannetv2-labels.combined.tsv");
  }
  const std::vector<std::string> published = published_class_names();
  if (std::find(published.begin(), published.end(), options.in) != published.end())
    return published_classes(options.in);
  if (is_tsv) {
    return load_scannet_classes(options.in, options.ids == "raw"     ? ScannetIds::raw
                                            : options.ids == "nyu40" ? ScannetIds::nyu40
                                                                     : ScannetIds::nyu13);
  }
  return import_classes(options.in);
}

ClassTable recolored(const ClassTable& table, const std::string& colors) {
  std::vector<ClassEntry> entries = table.entries();
  for (ClassEntry& entry : entries) {
    if (colors == "pascal") entry.color = pascal_color(entry.id);
    if (colors == "semfield") entry.color = ClassTable::default_color(entry.id);
  }
  return ClassTable(std::move(entries));
}

Json classes_json(const ClassTable& table) {
  Json classes = Json::array();
  for (const ClassEntry& entry : table.entries()) {
    char color[8];
    std::snprintf(color, sizeof color, "#%02x%02x%02x", entry.color[0], entry.color[1], entry.color[2]);
    classes.push_back({{"id", entry.id}, {"name", entry.name}, {"color", color}, {"ignored", entry.ignore}});
  }
  return classes;
}

int run(const ClassesOptions& options, AppContext& context) {
  const ClassTable table = recolored(table_of(options), options.colors);
  const std::string text = options.format == "yaml"  ? table.to_yaml()
                           : options.format == "csv" ? to_class_csv(table)
                                                     : to_cvat_labelmap(table);
  if (!options.out.empty()) write_file_atomic(options.out, text);
  if (context.json) {
    Json out{{"classes", classes_json(table)}};
    if (!options.out.empty()) out["file"] = options.out;
    print_json(context, out);
  } else if (options.out.empty()) {
    std::fputs(text.c_str(), stdout);
  } else {
    std::printf("classes: %d classes, %zu entries, file=%s\n", table.valid_count(), table.entries().size(),
                options.out.c_str());
  }
  return 0;
}

}  // namespace

Verb verb_classes() {
  return make_verb<ClassesOptions>("classes", 140, "convert class tables from and to the formats of other tools", run);
}

}  // namespace semfield::app
