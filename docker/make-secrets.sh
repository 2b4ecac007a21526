#!/bin/sh
# Make the secrets that compose.yml mounts, in docker/secrets or the given folder; existing ones stay.
#   queue.acl  the queue's access list: our user may use the project's keys, everybody else only `ping`
#   redis_url  the queue's address with our user's password
set -eu
folder=${1:-$(dirname "$0")/secrets}
if [ -e "$folder/redis_url" ]; then
  echo "make-secrets: $folder holds secrets already" >&2
  exit 0
fi
mkdir -p "$folder"
chmod 700 "$folder" # the files are mounted into containers of other users, who must be able to read them
umask 022
password=$(od -An -N32 -tx1 /dev/urandom | tr -d ' \n')
digest=$(printf %s "$password" | sha256sum | cut -d ' ' -f 1)
{
  echo "user default on nopass nocommands +ping"
  echo "user intrasplat on #$digest ~{intrasplat}:* resetchannels +@all -@dangerous +bgrewriteaof"
} >"$folder/queue.acl"
echo "redis://intrasplat:$password@queue:6379/0" >"$folder/redis_url"
echo "make-secrets: made $folder/queue.acl and $folder/redis_url" >&2
