// pairs: every left-out component against the run that keeps it; --write-docs renews the shipped table.
#include <fmt/format.h>

#include <algorithm>
#include <cstdio>
#include <ctime>
#include <filesystem>
#include <optional>

#include "app/json_output.h"
#include "app/verb.h"
#include "run/run_folder.h"
#include "studies/leave_out_page.h"
#include "system/files.h"

namespace semfield::app {

namespace {

struct PairsStudyOptions {
  std::vector<std::string> only;  ///< names of pairs; empty: all
  std::vector<std::string> set;
  std::string write_docs;  ///< folder of leave_out.json and leave_out.md
  int rounds = 9;
  int seeds = 5;
  int seed_steps = 400;
};

namespace fs = std::filesystem;

std::string about(const PairsStudyOptions& options, const PairOptions& pairs) {
  const Environment e = this_environment();
  const std::time_t now = std::time(nullptr);
  std::tm utc{};
  ::gmtime_r(&now, &utc);
  return fmt::format("`semfield-study pairs{}` on one core of {}, {}, {:04}-{:02}-{:02}; {} rounds; scene: {}.",
                     options.only.empty() ? "" : " --only ...", e.cpu, e.compiler, utc.tm_year + 1900, utc.tm_mon + 1,
                     utc.tm_mday, pairs.rounds, join(pairs.set));
}

// leave_out.json and the tables of leave_out.md in a folder.
class DocsFolder {
 public:
  // Before anything is measured: a page without a place for its tables is refused.
  explicit DocsFolder(const fs::path& folder)
      : json_((folder / "leave_out.json").string()), page_((folder / "leave_out.md").string()) {
    (void)with_findings(read_text_file(page_), {}, page_);
  }
  void write(const LeaveOutFindings& fresh) const {
    const LeaveOutFindings all =
        fs::exists(json_) ? merged(parse_findings(read_text_file(json_), json_), fresh) : fresh;
    write_file_atomic(page_, with_findings(read_text_file(page_), all, page_));
    write_file_atomic(json_, findings_json(all));
  }

 private:
  std::string json_, page_;
};

int run(const PairsStudyOptions& options, AppContext& context) {
  std::optional<DocsFolder> docs;
  if (!options.write_docs.empty()) docs.emplace(options.write_docs);
  PairOptions pairs;
  pairs.rounds = options.rounds;
  pairs.seeds = options.seeds;
  pairs.seed_steps = options.seed_steps;
  pairs.set = {"scene.frames=30", "scene.test_frames=5", "scene.width_px=80", "scene.height_px=60", "train.rays=256"};
  pairs.set.insert(pairs.set.end(), options.set.begin(), options.set.end());
  std::vector<std::string> names;
  for (const LeaveOutPair& pair : leave_out_pairs()) names.push_back(pair.name);
  for (const std::string& name : options.only) {
    if (std::find(names.begin(), names.end(), name) == names.end())
      throw Error(ErrorKind::usage, "study.name.unknown", "--only " + name + ": there is no such pair",
                  "choose of " + join(names));
  }
  LeaveOutFindings findings;
  bool all_hold = true;
  // Whatever loads libraries comes last, as it is in the list.
  for (const LeaveOutPair& pair : leave_out_pairs()) {
    if (!options.only.empty() && std::find(options.only.begin(), options.only.end(), pair.name) == options.only.end())
      continue;
    const PairResult result = run_pair(pair, pairs, context.registry, shared_file);
    findings.rows.push_back(finding_of(pair, result));
    const LeaveOutFinding& row = findings.rows.back();
    const bool counts = pair.but.empty();
    all_hold = all_hold && (row.holds || !counts);
    if (context.json) continue;
    std::printf("%-22s %s  %-14s %s\n%26s saves %s  [%.1f s]\n", row.name.c_str(), row.proof.c_str(),
                !counts     ? "kept"
                : row.holds ? "holds"
                            : "DOES NOT HOLD",
                row.result.c_str(), "", row.saving.c_str(), result.seconds);
    std::fflush(stdout);
  }
  findings.about = about(options, pairs);
  if (docs) docs->write(findings);
  if (context.json) print_json(context, Json::parse(findings_json(findings)));
  return all_hold ? 0 : static_cast<int>(ErrorKind::failure);
}

void words(VerbWords& verb, PairsStudyOptions& options) {
  verb.repeated("--only PAIR", options.only, "pairs to run (default: all)");
  verb.value_in("--rounds N", options.rounds, 1, 1000, "number of alternating timed rounds");
  verb.value_in("--seeds N", options.seeds, 2, 1000, "runs on each side of a statistical pair");
  verb.value_in("--steps N", options.seed_steps, 20, 1000000, "steps of each of these runs");
  verb.repeated("--set KEY=VALUE", options.set, "override a value of all pairs: --set train.rays=200");
  verb.value("--write-docs FOLDER", options.write_docs,
             "folder in which leave_out.json and leave_out.md are renewed: docs/reference");
}

}  // namespace

Verb verb_pairs() {
  return with_json(make_verb<PairsStudyOptions>(
      "pairs", 40, "compare runs that leave a component out with runs that keep it: the proof, and what it saves",
      words, run));
}

}  // namespace semfield::app
