// classes: class tables from and to the forms of other tools.
#include <algorithm>
#include <cstdio>
#include <filesystem>

#include "classes/class_import.h"
#include "system/files.h"
#include "verbs.h"

namespace semfield::app {

namespace {

void check_choice(const std::string& option, const std::string& value, const std::vector<std::string>& known) {
  if (std::find(known.begin(), known.end(), value) != known.end()) return;
  const std::string near = did_you_mean(value, known);
  throw Error(ErrorKind::usage, option + " " + value + ": expected one of " + join(known),
              near.empty() ? "" : "did you mean " + near + "?");
}

ClassTable table_of(const ClassesOptions& options) {
  const bool scannet = std::filesystem::path(options.in).extension() == ".tsv";
  if (options.ids != "raw" && !scannet) {
    throw Error(ErrorKind::usage, "--ids " + options.ids + ": '" + options.in + "' is no table of ScanNet",
                "give scannetv2-labels.combined.tsv");
  }
  const std::vector<std::string> published = published_class_names();
  if (std::find(published.begin(), published.end(), options.in) != published.end())
    return published_classes(options.in);
  if (scannet) {
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

}  // namespace

int run_classes(const ClassesOptions& options) {
  check_choice("--format", options.format, {"yaml", "csv", "cvat"});
  check_choice("--ids", options.ids, {"raw", "nyu40", "nyu13"});
  check_choice("--colors", options.colors, {"keep", "pascal", "semfield"});
  const ClassTable table = recolored(table_of(options), options.colors);
  const std::string text = options.format == "yaml"  ? table.to_yaml()
                           : options.format == "csv" ? to_class_csv(table)
                                                     : to_cvat_labelmap(table);
  if (options.out.empty()) {
    std::fputs(text.c_str(), stdout);
  } else {
    write_file_atomic(options.out, text);
    std::printf("classes: %d classes, %zu entries, file=%s\n", table.valid_count(), table.entries().size(),
                options.out.c_str());
  }
  return 0;
}

}  // namespace semfield::app
