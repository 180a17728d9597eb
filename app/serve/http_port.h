// Which port a server may take, checked with the system before it starts, so that a refusal has its cause.
#pragma once

#include <netinet/in.h>

#include <string>

namespace semfield::app {

/// A socket that listens at `port`, 0: any, which it becomes; -1 with errno where the system refuses.
int listen_at(const in_addr& address, int& port);

/// A port of `address` that can be listened on: `port`, or with `next` the first free one of the hundred from there;
/// for 0 any. Throws Error: usage for an address that is none, unavailable for one that this machine has not, and for a
/// port that is taken or forbidden.
int free_port(const std::string& address, int port, bool next);

}  // namespace semfield::app
