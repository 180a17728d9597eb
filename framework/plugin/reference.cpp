// Lists, tables and the reference page.
#include "plugin/reference.h"

#include <fmt/format.h>

#include <algorithm>

#include "core/error.h"

namespace semfield {

namespace {

std::vector<ParamDoc> params_of(const PluginEntry& entry) {
  const std::unique_ptr<PluginParams> params = entry.new_params();
  return describe_params(described(*params));
}

std::vector<const PluginEntry*> entries_of(const Registry& registry, PluginKind kind) {
  std::vector<const PluginEntry*> of_kind;
  for (const PluginEntry* entry : registry.entries()) {
    if (entry->kind == kind) of_kind.push_back(entry);
  }
  return of_kind;
}

std::string padded(std::string text, std::size_t width) {
  if (text.size() < width) text.append(width - text.size(), ' ');
  return text;
}

// "linear, smoothstep" for a choice, else the range.
std::string allowed_values(const ParamDoc& doc) { return doc.choices.empty() ? doc.range : join(doc.choices); }

// A bar would end the cell.
std::string cell(const std::string& text) {
  std::string out;
  for (const char c : text) {
    if (c == '|') out += '\\';
    out += c;
  }
  return out;
}

std::string code(const std::string& text) { return text.empty() ? "" : "`" + cell(text) + "`"; }

std::string details_text(const Registry& registry, const PluginEntry& entry) {
  std::string text = std::string(kind_name(entry.kind)) + " " + entry.name + "\n  " + entry.summary + "\n";
  text += "  module " + entry.module + ", devices: " + devices_text(registry, entry) + "\n";
  for (const ParamDoc& doc : params_of(entry)) {
    text += "\n  " + doc.name + ": " + doc.type + " = " + (doc.default_value.empty() ? "\"\"" : doc.default_value);
    if (const std::string allowed = allowed_values(doc); !allowed.empty()) text += "   (" + allowed + ")";
    text += "\n      " + doc.help + "\n";
  }
  return text;
}

}  // namespace

std::string devices_text(const Registry& registry, const PluginEntry& entry) {
  if (entry.kind == PluginKind::dataset) return "host";
  const std::string devices =
      registry.kernels().devices_of(std::string(kind_name(entry.kind)) + " '" + entry.name + "'");
  const std::string cpu(device_name(Device::cpu));
  if (entry.kind == PluginKind::loss) return devices.empty() ? cpu : cpu + ", " + devices;
  return devices.empty() ? cpu : devices;  // no table: plain C++
}

std::string plugins_list_text(const Registry& registry) {
  std::size_t width = 0;
  for (const PluginEntry* entry : registry.entries()) width = std::max(width, entry->name.size());
  std::string text;
  for (const PluginKind kind : kPluginKinds) {
    const std::vector<const PluginEntry*> entries = entries_of(registry, kind);
    if (entries.empty()) continue;
    text += std::string(kind_folder(kind)) + "\n";
    for (const PluginEntry* entry : entries)
      text += "  " + padded(entry->name, width) + "  " + entry->summary + " [" + entry->module + "]\n";
  }
  return text;
}

std::string plugin_details_text(const Registry& registry, const std::string& name) {
  std::string text;
  std::vector<std::string> known;
  for (const PluginEntry* entry : registry.entries()) {
    known.push_back(entry->name);
    if (entry->name != name) continue;
    if (!text.empty()) text += "\n";
    text += details_text(registry, *entry);
  }
  if (!text.empty()) return text;
  throw Error(ErrorKind::config, "plugin.name.unknown", "no plugin named '" + name + "'; known: " + join(known),
              near_name_remedy(name, known));
}

std::string support_matrix_text(const Registry& registry) {
  std::string text = "| kind | plugin | devices | module |\n|---|---|---|---|\n";
  for (const PluginKind kind : kPluginKinds) {
    for (const PluginEntry* entry : entries_of(registry, kind)) {
      text += "| " + std::string(kind_name(kind)) + " | " + entry->name + " | " + devices_text(registry, *entry) +
              " | " + entry->module + " |\n";
    }
  }
  return text;
}

std::string parameter_table_markdown(const std::vector<ParamDoc>& docs) {
  if (docs.empty()) return "No parameters.\n";
  std::string text = "| parameter | type | default | allowed | meaning |\n|---|---|---|---|---|\n";
  for (const ParamDoc& doc : docs) {
    text += "| " + code(doc.name) + " | " + cell(doc.type) + " | " + code(doc.default_value) + " | " +
            cell(allowed_values(doc)) + " | " + cell(doc.help) + " |\n";
  }
  return text;
}

std::string parameter_table_markdown(const PluginEntry& entry) { return parameter_table_markdown(params_of(entry)); }

std::string plugins_markdown(const Registry& registry) {
  std::string text = "# Plugins\n\n`semfield plugins show NAME` prints the same of one plugin.\n";
  for (const PluginKind kind : kPluginKinds) {
    const std::vector<const PluginEntry*> entries = entries_of(registry, kind);
    if (entries.empty()) continue;
    std::string title = std::string(kind_folder(kind));
    std::replace(title.begin(), title.end(), '_', ' ');
    title[0] = static_cast<char>(title[0] - 'a' + 'A');
    text += "\n## " + title + "\n";
    for (const PluginEntry* entry : entries) {
      text += "\n### `" + entry->name + "`\n\n" + entry->summary + "\n\nModule " + entry->module + ".\n\n" +
              parameter_table_markdown(*entry);
    }
  }
  return text;
}

}  // namespace semfield

// The sentences of failed shape checks.
namespace semfield::view_checks {

void fail_shape(const char* call, const char* view, std::int64_t rows, std::int32_t cols, std::int64_t want_rows,
                std::int32_t want_cols) {
  fail(call, fmt::format("{} is [{}, {}], expected [{}, {}]", view, rows, cols, want_rows, want_cols));
}

void fail(const char* call, const std::string& what) {
  throw Error(ErrorKind::internal, "internal.view.shape", std::string(call) + ": " + what);
}

}  // namespace semfield::view_checks
