#compdef rig
_rig() {
    local line
    local -a values ends
    for line in "${(@f)$(${~words[1]} __complete zsh "${(j: :)words[1,CURRENT]}" 2>/dev/null)}"; do
        case $line in
        $'\t/') _files -/ ;;
        $'\t'*) ends=(${=line}); _files ${ends:+-g} ${ends:+"${(j: :)${(@)ends/#/*}}"} ;;
        ?*) values+=("${${line%%$'\t'*}//:/\\:}:${line#*$'\t'}") ;;
        esac
    done
    (( $#values )) || return
    if [[ $values[1] == *=:* ]]; then _describe '' values -S ''; else _describe '' values; fi
}
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit }
compdef _rig rig
