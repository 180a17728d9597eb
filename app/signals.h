// What the program does about signals: stopping in order, saving on request, limits that show as failed calls.
#pragma once

#include <string>

namespace semfield::app {

/// At the start of the program. The stack is claimed (claim_stack; std::bad_alloc without room). SIGPIPE and SIGXFSZ
/// are ignored: a closed pipe and a file limit show as failed writes, which are handled. SIGINT, SIGTERM and SIGHUP end
/// it and leave no temporary file. Standard streams that the caller closed are opened on /dev/null, so that no file of
/// ours gets their numbers and no message lands in it.
void prepare_process();

/// SIGINT and SIGTERM raise a flag; a second one says that the work of stopping goes on, a third ends the process at
/// once. `told`: whether the program says so.
void install_stop_signals(bool told = true);
/// In a process that follows rank 0, which saves and ends both: SIGINT and SIGTERM raise the flag alone, however often
/// they come, and SIGHUP is ignored.
void leave_stop_to_rank_0();
/// Another process of the run received SIGTERM: this one does as if it had come here. A launcher that sent it to all of
/// them has not asked twice.
void stop_with_the_others();
/// 0, or the number of the signal received.
int stop_signal();

/// After install_stop_signals: while a stop does not wait, one signal ends the process at once, with the sentence
/// `farewell` on stderr, because there is nothing that the program would still save.
void stop_waits(bool waits, const std::string& farewell = {});

/// SIGHUP asks for a checkpoint instead of ending the process.
void install_save_signal();
/// Whether SIGHUP came since the last call.
bool take_save_request();

/// Delivers what stdout still holds; the exit code is `code`, or that of an Error(io) when a result could not be
/// delivered. A reader that has closed its end (`| head -1`) has what it wanted: no error.
int finish_stdout(int code);

}  // namespace semfield::app
