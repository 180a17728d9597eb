#include "app/verbs/plugins/plugin_output.h"

#include <cstdio>
#include <nlohmann/json.hpp>

#include "app/json_output.h"
#include "config/params_read.h"
#include "core/error.h"
#include "core/findings.h"
#include "execution/device_library.h"
#include "session/assembly.h"

namespace semfield::app {

namespace {

Json entry_json(const PluginEntry& entry) {
  Json json{
      {"kind", kind_name(entry.kind)}, {"name", entry.name}, {"summary", entry.summary}, {"module", entry.module}};
  json["parameters"] = Json::array();
  const std::unique_ptr<PluginParams> params = entry.new_params();
  for (const ParamDoc& doc : describe_params([&params](ParamVisitor& visit) { params->describe(visit); })) {
    Json parameter{{"name", doc.name},
                   {"type", doc.type},
                   {"default", doc.default_value},
                   {"range", doc.range},
                   {"help", doc.help}};
    if (!doc.choices.empty()) parameter["choices"] = doc.choices;
    json["parameters"].push_back(std::move(parameter));
  }
  return json;
}

}  // namespace

void print_text(const std::string& text) { std::fwrite(text.data(), 1, text.size(), stdout); }

void print_plugins_json(const AppContext& context, const std::string& only) {
  Json all = Json::array();
  for (const PluginEntry* entry : context.registry.entries()) {
    if (only.empty() || entry->name == only) all.push_back(entry_json(*entry));
  }
  print_json(context, {{"plugins", all}});
}

void add_cuda_kernels(AppContext& context) {
  if (!has_cuda_library()) return;
  try {
    semfield::add_cuda_kernels(context.registry);
  } catch (const Error& error) {
    print_note(context, shown(error));
  }
}

}  // namespace semfield::app
