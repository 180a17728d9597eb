// config: check, explain, diff, schema.
#include <cstdio>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "config/compose.h"
#include "config/explain.h"
#include "config/schema.h"
#include "core/log.h"
#include "train/run_config.h"
#include "verbs.h"

namespace semfield::app {
namespace {

void print(const std::string& text) { std::fwrite(text.data(), 1, text.size(), stdout); }

ConfigNode compose(const ConfigOptions& options, AppContext& context) {
  load_modules(options.plugins, context);
  return compose_config(options.config, options.set);
}

const char* severity_name(Severity severity) {
  return severity == Severity::error ? "error" : severity == Severity::warning ? "warning" : "note";
}

nlohmann::ordered_json findings_json(const Diagnostics& diagnostics) {
  nlohmann::ordered_json findings = nlohmann::ordered_json::array();
  for (const Diagnostic& finding : diagnostics.all()) {
    findings.push_back({{"severity", severity_name(finding.severity)},
                        {"where", finding.where},
                        {"message", finding.message},
                        {"remedy", finding.remedy}});
  }
  return findings;
}

/// A config file, or the resolved one of a run folder.
std::string config_of(const std::string& path) {
  std::error_code ignored;
  if (!std::filesystem::is_directory(path, ignored)) return path;
  return (std::filesystem::path(path) / "run.yaml").string();
}

ParamDoc text_doc(const std::string& name, const std::string& type, const std::string& help) {
  ParamDoc doc;
  doc.name = name;
  doc.type = type;
  doc.help = help;
  return doc;
}

SchemaChoice slot(const std::string& path, const std::string& sentence, PluginKind kind, const Registry& registry) {
  SchemaChoice choice{path, sentence, {}};
  for (const PluginEntry* entry : registry.entries()) {
    if (entry->kind != kind) continue;
    const std::unique_ptr<PluginParams> params = entry->new_params();
    choice.alternatives.push_back(
        {entry->name, entry->summary, describe_params([&](ParamVisitor& visit) { params->describe(visit); })});
  }
  return choice;
}

}  // namespace

int run_config_check(const ConfigOptions& options, AppContext& context) {
  const ConfigNode tree = compose(options, context);
  Diagnostics diagnostics;
  read_run_config(tree, context.registry, diagnostics);
  if (context.json) {
    print(findings_json(diagnostics).dump(2) + "\n");
    return diagnostics.has_errors() ? static_cast<int>(ErrorKind::config) : 0;
  }
  for (const Diagnostic& finding : diagnostics.all()) {
    if (finding.severity == Severity::warning) log_warning(finding.text());
  }
  diagnostics.throw_if_errors(ErrorKind::config,
                              std::to_string(diagnostics.error_count()) + " error(s) in " + options.config);
  print_note(context, options.config + ": no errors");
  return 0;
}

int run_config_explain(const ConfigOptions& options, AppContext& context) {
  ConfigNode tree = compose(options, context);
  Diagnostics diagnostics;
  const RunConfig config = read_run_config(tree, context.registry, diagnostics);
  if (diagnostics.has_errors()) {  // what was written is worth seeing all the same
    log_warning("defaults are not shown, the config has errors: see `semfield config check " + options.config + "`");
  } else {
    tree = with_origins(resolved_config(config), tree);
  }
  print(explain_config(tree));
  return 0;
}

int run_config_diff(const std::string& a, const std::string& b, AppContext& context) {
  const std::string text = diff_config(compose_config(config_of(a)), compose_config(config_of(b)));
  print(text);
  if (text.empty()) print_note(context, "no difference");
  return 0;
}

int run_config_schema(AppContext& context) {
  std::vector<SchemaSection> sections{
      {"",
       "A run of semfield",
       {text_doc("name", "text", "name of the run; the file's name by default"),
        text_doc("base_dir", "text", "folder where the scene's relative paths start; the file's own by default"),
        text_doc("plugins", "list of text", "loadable plugin modules, relative to the file")}},
      {"passes[]",
       "sampling passes, each from the samples of the one before",
       {text_doc("name", "text", "name of the pass"),
        text_doc("like", "text", "name of an earlier pass whose keys this one starts from")}}};
  for (const SectionDoc& section : describe_sections())
    sections.push_back({section.path, section.sentence, section.params});
  const Registry& registry = context.registry;
  const std::vector<SchemaChoice> slots{
      slot("scene", "the dataset and what is taken from it", PluginKind::dataset, registry),
      slot("passes[].sampler", "where a ray is sampled", PluginKind::sampler, registry),
      slot("passes[].position", "encoder of positions", PluginKind::encoder, registry),
      slot("passes[].direction", "encoder of view directions", PluginKind::encoder, registry),
      slot("passes[].field", "density, colour and feature at a point", PluginKind::field, registry)};
  print(json_schema_of("semfield configuration", sections, slots));
  return 0;
}

}  // namespace semfield::app
