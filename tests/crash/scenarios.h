// The saves that faults are thrown into, and what a fresh process finds after one.
#pragma once

#include "labels/clicks/click_log.h"

namespace semfield::testing_crash {

/// `checkpoint`: step 300 over 100 and 200, with `latest`, the deletion of 100 and a later, damaged step 400 that steps
/// aside. `clicks`: an event appended to a log, which is no file that replaces another (click_log_test.cpp). `first`: a
/// first checkpoint, in a folder that does not exist yet. `scene`: a packed scene over another.
/// `text`: a run folder's run.yaml over another.
enum class Save { checkpoint, first, scene, text, clicks };
/// Those that replace a file.
inline constexpr Save kSaves[] = {Save::checkpoint, Save::first, Save::scene, Save::text};
const char* name_of(Save what);
Save save_of(const std::string& name);

/// The log of the save `clicks`, and its events: "click-0", ...
std::string click_log_path(const std::string& folder);
LabelEvent click_event(int number);

/// The state before, in an empty folder.
void prepare(Save what, const std::string& folder);
/// The save itself. Throws Error.
void perform(Save what, const std::string& folder);

struct Look {
  std::uint32_t crc = 0;  ///< of the newest file that verifies, byte for byte; 0: there is none
  int temporaries = 0;    ///< files named *.tmp below the folder, after what a next start does
  std::string bad;        ///< anything that is not as promised; empty: all is well
};
/// As the next process does: cleans up, finds the newest that verifies, reads all of it.
Look look(Save what, const std::string& folder);

}  // namespace semfield::testing_crash
