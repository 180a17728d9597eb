// A session whose steps and rendering are those of several processes. Rank 0 alone reads the scene and writes files;
// the others get from it what their networks are made of, and follow.
#pragma once

#include <vector>

#include "execution/ranks/ranks.h"
#include "session/session.h"

namespace semfield {

/// Rank 0, once `session` has its plan and its pipeline on the CPU: the other ranks assemble the same network,
/// and from now on it runs on the device of all ranks that `how` names. Device `cuda` is a device for each rank of a
/// host, in turn. Throws what a rank could not do, with its name; the others then wait for another session.
void lead(Ranks& ranks, Session& session, Registry& registry, RunOn how);

/// What the other ranks do until rank 0 calls dismiss: they serve the sessions that it leads, one after the other.
/// Throws RankLost.
void follow(Ranks& ranks, Registry& registry);
/// Rank 0, when it leads no session any more.
void dismiss(Ranks& ranks);

/// All ranks, once: those that may run on the same cores share them (set_thread_count). Returns a sentence about
/// processes and threads. Throws Error(unavailable) where ranks are programs of different versions, or where CPUs
/// would compute with different instructions, so that the ranks' tensors would drift apart.
std::string prepare_ranks(Ranks& ranks, const std::string& version);

}  // namespace semfield
