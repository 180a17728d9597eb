// config schema: the JSON schema of configurations, or of sweep files.
#include <cstdio>

#include "app/verb.h"
#include "config/schema.h"
#include "report/sweep/sweep_schema.h"
#include "session/settings/label_config.h"
#include "session/settings/run_config.h"

namespace semfield::app {

namespace {

struct SchemaOptions {
  bool of_sweeps = false;
};

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

int run(const SchemaOptions& options, AppContext& context) {
  if (options.of_sweeps) {
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
  const std::vector<SchemaChoice> choices{
      {"losses[]", "terms of the loss in addition to colour and semantics; each type once",
       alternatives(context.registry, PluginKind::loss)},
      {"heads[]", "heads in addition to that of class logits", alternatives(context.registry, PluginKind::head)},
      {"heads[].branch.position", "position encoder of the head's branch",
       alternatives(context.registry, PluginKind::encoder)},
      {"heads[].branch.field", "network of the head's branch", alternatives(context.registry, PluginKind::field)},
      {"scene.labels.from", "label files to train on instead of the dataset's own labels",
       alternatives(context.registry, PluginKind::label_reader)},
      {"scene.labels.degrade[]", "changes of the training labels, in order",
       alternatives(context.registry, PluginKind::degradation)},
      {"objects.method", "what `semfield objects` learns from segments",
       alternatives(context.registry, PluginKind::grouping)},
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

void words(VerbWords& verb, SchemaOptions& options) {
  verb.flag("--sweep", options.of_sweeps, "print the schema of sweep files instead");
}

}  // namespace

Verb verb_config_schema() {
  return make_verb<SchemaOptions>("config schema", 40, "print a JSON schema of configurations (and --plugin modules)",
                                  words, run);
}

}  // namespace semfield::app
