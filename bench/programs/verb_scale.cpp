// scale: steps on 1, 2, ... ranks or GPUs, beside a model of what more of them would give.
#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <filesystem>
#include <optional>

#include "app/bench/bench_tools.h"
#include "app/json_output.h"
#include "app/verb.h"
#include "compute/parallel.h"
#include "programs/scale_start.h"
#include "studies/scale_page.h"
#include "system/files.h"

namespace semfield::app {

namespace {

struct ScaleStudyOptions {
  std::string out;         ///< folder; "": a temporary one
  std::string write_docs;  ///< folder of the documents
  std::vector<std::string> only, combine;
  std::optional<int> ranks;
  int repeats = 2;
  bool quick = false;
};

namespace fs = std::filesystem;

// For runs, removed at the end. In the user's folder it stays where a training failed, with its log.
class WorkFolder {
 public:
  explicit WorkFolder(const std::string& out)
      : keep_(!out.empty()),
        path_(keep_
                  ? fs::absolute(out) / "work"
                  : fs::temp_directory_path() /
                        fmt::format("semfield_scale_{}", std::chrono::steady_clock::now().time_since_epoch().count())) {
    remove();
    create_folders(path_.string());
  }
  ~WorkFolder() {
    if (!keep_) remove();
  }
  WorkFolder(const WorkFolder&) = delete;
  WorkFolder& operator=(const WorkFolder&) = delete;
  std::string path() const { return path_.string(); }
  void done() { keep_ = false; }

 private:
  void remove() const {
    std::error_code ignored;  // it costs disk alone
    fs::remove_all(path_, ignored);
  }
  bool keep_;
  fs::path path_;
};

ScaleResults measured(const ScaleStudyOptions& options, AppContext& context) {
  WorkFolder folder(options.out);
  const StudyTools study = study_tools(context);
  ScaleBenchOptions bench;
  bench.only = options.only;
  bench.most_ranks = options.ranks.value_or(0);
  bench.repeats = options.repeats;
  bench.quick = options.quick;
  const ScaleTools tools{study, folder.path(), hardware_threads(), need_mpirun,
                         [&](const ScaleStart& start) { return start_ranks(start, folder.path(), context); }};
  ScaleResults results = measure_scale(bench, tools);
  folder.done();
  return results;
}

void write_docs(const std::string& folder, const ScaleResults& fresh) {
  if (fresh.quick)
    throw Error(ErrorKind::usage, "usage.flag.conflict", "--write-docs: figures of --quick are of narrow networks",
                "measure without --quick");
  const fs::path docs = folder;
  const std::string page = (docs / "evidence" / "scale.md").string(),
                    json = (docs / "evidence" / "scale.json").string();
  const ScaleResults all = fs::exists(json) ? merged(parse_scale_json(read_text_file(json), json), fresh) : fresh;
  const std::string text = with_scale(read_text_file(page), all, page);
  write_file_atomic((docs / "images" / "scale.svg").string(), scale_figure(all));
  write_file_atomic(page, text);
  write_file_atomic(json, scale_json(all));
}

int run(const ScaleStudyOptions& options, AppContext& context) {
  ScaleResults results;
  for (const std::string& file : options.combine)
    results = merged(std::move(results), parse_scale_json(read_text_file(file), file));
  if (options.combine.empty() || !options.only.empty()) {
    ScaleResults fresh = measured(options, context);
    const std::vector<std::string> missing = fresh.missing;
    results = options.combine.empty() ? std::move(fresh) : merged(std::move(results), fresh);
    results.missing = missing;
  }
  const std::string text =
      "# Steps on several ranks\n\n" + scale_measured(results) + "\n## Model\n\n" + scale_model(results);
  if (!options.out.empty()) {
    const fs::path folder = options.out;
    create_folders(folder.string());
    write_file_atomic((folder / "results.json").string(), scale_json(results));
    write_file_atomic((folder / "scale.md").string(), text);
    write_file_atomic((folder / "scale.svg").string(), scale_figure(results));
  }
  if (!options.write_docs.empty()) write_docs(options.write_docs, results);
  const bool differ = std::any_of(results.bits.begin(), results.bits.end(),
                                  [](const ScaleBits& bits) { return !bits.difference.empty(); });
  if (context.json) {
    Json out = Json::parse(scale_json(results));
    out["not_measured"] = results.missing;
    print_json(context, out);
  } else {
    std::printf("%s\n", text.c_str());
    for (const std::string& why : results.missing) std::printf("not measured: %s\n", why.c_str());
    std::printf("%s\n", scale_line(results).c_str());
  }
  return differ ? static_cast<int>(ErrorKind::failure) : 0;
}

void words(VerbWords& verb, ScaleStudyOptions& options) {
  verb.value("--out FOLDER", options.out, "folder for results.json, scale.md and scale.svg");
  verb.value_in("--ranks N", options.ranks, 1, 1024, "ranks at most (default: as many as there are cores or GPUs)");
  verb.list("--only LIST", options.only, "parts to measure, with commas (default: all)", kScaleParts);
  verb.value_in("--repeats N", options.repeats, 1, 100, "rounds, each of which starts every training once");
  verb.flag("--quick", options.quick, "narrow networks and few rays, for tests");
  verb.list("--combine FILES", options.combine,
            "files results.json; their figures count as if they were measured here, and nothing else is measured "
            "without --only");
  verb.value("--write-docs FOLDER", options.write_docs,
             "folder of the documents, in which evidence/scale.md, its data and its figure are renewed: docs");
}

}  // namespace

Verb verb_scale() {
  return with_json(make_verb<ScaleStudyOptions>(
      "scale", 35, "time steps on several ranks or GPUs, compare their bits, and model many more", words, run));
}

}  // namespace semfield::app
