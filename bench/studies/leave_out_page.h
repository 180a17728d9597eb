// What pairs found, as the shipped data docs/reference/leave_out.json and the tables of the page
// docs/reference/leave_out.md.
#pragma once

#include <string>
#include <vector>

#include "studies/leave_out_pairs.h"

namespace semfield {

/// One line of the page.
struct LeaveOutFinding {
  std::string name, component, rule, proof, kept_by, but;
  bool holds = false;
  std::string result;
  std::string saving;  ///< "12.3 % of a step (1.21 against 1.38 ms)"; never empty after a run
};

struct LeaveOutFindings {
  std::string about;  ///< machine, date, command
  std::vector<LeaveOutFinding> rows;
};

LeaveOutFinding finding_of(const LeaveOutPair& pair, const PairResult& result);
std::string saving_text(const PairCost& cost);

std::string findings_json(const LeaveOutFindings& findings);
/// Throws Error(data).
LeaveOutFindings parse_findings(const std::string& json, const std::string& name);
/// `fresh` in the place of the rows of the same name, in the order of leave_out_pairs(); others stay.
LeaveOutFindings merged(const LeaveOutFindings& old, const LeaveOutFindings& fresh);
/// `page` with its tables renewed; its words are nobody's but the writer's. `name` of the file. Throws Error(data)
/// where a mark is missing.
std::string with_findings(std::string page, const LeaveOutFindings& findings, const std::string& name);

}  // namespace semfield
