// config check, explain, diff, schema.
#include <cstdio>

#include "config/compose.h"
#include "config/explain.h"
#include "config/schema.h"
#include "settings/label_config.h"
#include "settings/loss_config.h"
#include "settings/run_config.h"
#include "sweep/sweep_schema.h"
#include "verbs.h"

namespace semfield::app {

namespace {

std::vector<SchemaAlternative> alternatives(const Registry& registry, PluginKind kind) {
  std::vector<SchemaAlternative> out;
  for (const PluginEntry* entry : registry.entries()) {
    if (entry->kind != kind) continue;
    const std::unique_ptr<PluginParams> params = entry->new_params();
    out.push_back(
        {entry->name, entry->summary, describe_params([&](ParamVisitor& visit) { params->describe(visit); })});
  }
  return out;
}

}  // namespace

int run_config_check(const ConfigOptions& options, AppContext& context) {
  load_run_config(options.config, options.set, context.registry);
  std::printf("%s: no errors\n", options.config.c_str());
  return 0;
}

int run_config_explain(const ConfigOptions& options, AppContext& context) {
  const ConfigNode written = compose_config(options.config, options.set);
  const RunConfig config = load_run_config(options.config, options.set, context.registry);
  std::fputs(explain_config(with_origins(resolved_config(config), written)).c_str(), stdout);
  return 0;
}

int run_config_diff(const std::string& a, const std::string& b, AppContext& context) {
  const RunConfig first = load_run_config(a, {}, context.registry);
  const RunConfig second = load_run_config(b, {}, context.registry);
  std::fputs(diff_config(resolved_config(first), resolved_config(second)).c_str(), stdout);
  return 0;
}

int run_config_schema(bool of_sweeps, AppContext& context) {
  if (of_sweeps) {
    std::fputs(sweep_schema().c_str(), stdout);
    return 0;
  }
  std::vector<SchemaSection> sections;
  for (const SectionDoc& section : describe_sections())
    sections.push_back({section.path + (section.or_list ? "[?]" : ""), section.sentence, section.params});
  const ParamDoc name{"name", "text", "", "", "name of the run and its default folder", {}};
  const ParamDoc base{"base_dir",
                      "text",
                      "",
                      "",
                      "folder at which relative paths start that come from no file; default: the working folder",
                      {}};
  const ParamDoc plugins{
      "plugins",
      "list of text",
      "[]",
      "",
      "plugin modules that it needs, by path; see docs/reference/configuration.md for which are loaded",
      {}};
  sections.push_back({"", "", {name, base, plugins}});
  const ParamDoc pass{"name", "text", "main", "", "name of the pass, the prefix of its tensors", {}};
  const ParamDoc like{"like", "text", "", "", "an earlier pass that this one starts from", {}};
  sections.push_back({"passes[]", "one pass over the rays", {pass, like}});
  std::vector<SchemaAlternative> readers, degradations;
  for (const LabelStepDoc& doc : describe_label_steps())
    (doc.key == "from" ? readers : degradations).push_back({doc.type, doc.sentence, doc.params});
  std::vector<SchemaAlternative> losses;
  for (const LossDoc& doc : describe_losses()) losses.push_back({doc.type, doc.sentence, doc.params});
  const std::vector<SchemaChoice> choices{
      {"losses[]", "terms of the loss beside colour and semantics; each type once", losses},
      {"scene.labels.from", "label files to train on instead of the dataset's own labels", readers},
      {"scene.labels.degrade[]", "changes of the training labels, in order", degradations},
      {"scene", "where frames come from", alternatives(context.registry, PluginKind::dataset)},
      {"passes[].sampler", "where along a ray the field is evaluated",
       alternatives(context.registry, PluginKind::sampler)},
      {"passes[].position", "position encoder", alternatives(context.registry, PluginKind::encoder)},
      {"passes[].direction", "direction encoder; leave it out for a view-independent field",
       alternatives(context.registry, PluginKind::encoder)},
      {"passes[].field", "the network", alternatives(context.registry, PluginKind::field)},
      {"passes[].semantic[?].position", "position encoder of the semantic branch",
       alternatives(context.registry, PluginKind::encoder)},
      {"passes[].semantic[?].field", "network of the semantic branch",
       alternatives(context.registry, PluginKind::field)},
  };
  std::fputs(json_schema_of("Semfield configuration", sections, choices).c_str(), stdout);
  return 0;
}

}  // namespace semfield::app
