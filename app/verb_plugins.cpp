// plugins list, show, docs, matrix: what plugins there are and what they take.
#include <cstdio>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "config/params_read.h"
#include "core/error.h"
#include "model/device_backend.h"
#include "plugin/reference.h"
#include "system/files.h"
#include "verbs.h"

namespace semfield::app {

namespace {

namespace fs = std::filesystem;

void print(const std::string& text) { std::fwrite(text.data(), 1, text.size(), stdout); }

// What this build has for CUDA, into the registry's tables; no device is needed to tell. Generated pages do without it:
// they are the same for every build.
void add_cuda_kernels(AppContext& context) {
  if (!has_cuda_library()) return;
  try {
    cuda_library().add_kernels(context.registry.kernels());
  } catch (const Error& error) {
    print_note(context, error.what());
  }
}

nlohmann::ordered_json entry_json(const PluginEntry& entry) {
  nlohmann::ordered_json json{
      {"kind", kind_name(entry.kind)}, {"name", entry.name}, {"summary", entry.summary}, {"module", entry.module}};
  json["parameters"] = nlohmann::ordered_json::array();
  const std::unique_ptr<PluginParams> params = entry.new_params();
  for (const ParamDoc& doc : describe_params([&params](ParamVisitor& visit) { params->describe(visit); })) {
    nlohmann::ordered_json parameter{{"name", doc.name},
                                     {"type", doc.type},
                                     {"default", doc.default_value},
                                     {"range", doc.range},
                                     {"help", doc.help}};
    if (!doc.choices.empty()) parameter["choices"] = doc.choices;
    json["parameters"].push_back(std::move(parameter));
  }
  return json;
}

int print_json(const Registry& registry, const std::string& only) {
  nlohmann::ordered_json all = nlohmann::ordered_json::array();
  for (const PluginEntry* entry : registry.entries()) {
    if (only.empty() || entry->name == only) all.push_back(entry_json(*entry));
  }
  print(all.dump(1) + "\n");
  return 0;
}

// The generated pages of a source tree: docs/reference/plugins.md and the table in each plugin folder's README.
int refresh_tree(const fs::path& root, const AppContext& context) {
  int written = 0;
  const auto write_if_new = [&written](const fs::path& path, const std::string& text) {
    if (fs::exists(path) && read_text_file(path.string()) == text) return;
    write_file_atomic(path.string(), text);
    ++written;
  };
  fs::create_directories(root / "docs" / "reference");
  write_if_new(root / "docs" / "reference" / "plugins.md", plugins_markdown(context.registry));
  for (const PluginEntry* entry : context.registry.entries()) {
    const fs::path readme = root / "plugins" / (std::string(kind_name(entry->kind)) + "s") / entry->name / "README.md";
    if (fs::exists(readme)) write_if_new(readme, with_parameter_table(read_text_file(readme.string()), *entry));
  }
  print_note(context, std::to_string(written) + " generated pages changed under " + root.string());
  return 0;
}

}  // namespace

int run_plugins_list(AppContext& context) {
  if (context.json) return print_json(context.registry, {});
  print(plugins_list_text(context.registry));
  return 0;
}

int run_plugins_show(const std::string& name, AppContext& context) {
  add_cuda_kernels(context);
  const std::string text = plugin_details_text(context.registry, name);  // refuses an unknown name in either form
  if (context.json) return print_json(context.registry, name);
  print(text);
  return 0;
}

// `out`: "" prints the reference page, a file receives it, a source tree (a folder with plugins/) has all its generated
// pages renewed.
int run_plugins_docs(const std::string& out, AppContext& context) {
  if (!out.empty() && fs::is_directory(fs::path(out) / "plugins")) return refresh_tree(out, context);
  const std::string page = plugins_markdown(context.registry);
  if (out.empty()) {
    print(page);
  } else {
    write_file_atomic(out, page);
  }
  return 0;
}

int run_plugins_matrix(AppContext& context) {
  add_cuda_kernels(context);
  print(support_matrix_text(context.registry));
  return 0;
}

}  // namespace semfield::app
